"""Fixture of an exact reconstruction of an analytic room, in the form of a mapper's result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mpsfm_core.data import (
    DepthPrior,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    View,
)
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.mapping.scene.reconstruction import (
    MappingReport,
    MappingResult,
    MetricScale,
    Reconstruction,
    RegisteredImage,
)
from mpsfm_core.testing.synthetic.scenes import arc_poses, project, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 141.0, 80.5, 59.0)
GRID = (80, 60)


@dataclass(frozen=True)
class Solved:
    """Mapping problem and result, in which ``images/3.png`` is not registered."""

    problem: MappingProblem
    result: MappingResult
    views: dict[str, View]

    @property
    def best(self) -> Reconstruction:
        return self.result.reconstructions[0]


@pytest.fixture(scope="session")
def solved() -> Solved:
    scene, poses = room_scene(), arc_poses(4, 12.0)
    names = [f"images/{i}.png" for i in range(4)]
    rng = np.random.default_rng(0)
    points = _surface_points(scene, poses[0], rng)
    single = _surface_points(scene, poses[1], rng)[:5]
    problem_images, registered, views = [], [], {}
    for index, (name, pose) in enumerate(zip(names, poses, strict=True)):
        views[name] = View(name, scene.render(CAMERA, pose).rgb, CAMERA)
        small = scene.render(CAMERA.resized(*GRID), pose)
        ones = np.ones(small.depth.shape, np.float32)
        depth = DepthPrior(small.depth, 1e-4 * ones, small.depth > 0)
        seen = points if index != 1 else np.vstack([points, single])
        xy, _ = project(CAMERA, pose, seen)
        # The last keypoint has no 3D point; keypoints of single-view points are the rows before.
        keypoints = np.vstack([xy, [[1.0, 2.0]]])
        ids = np.append(np.arange(len(seen)), -1)
        normals = NormalPrior.from_arrays(small.normals, 0.01 * ones)
        problem_images.append(MappingImage(name, CAMERA, keypoints, depth, normals))
        registered.append(
            RegisteredImage(index, name, CAMERA, pose[:, :3], pose[:, 3], ids, depth, 1.0)
        )
    everything = np.vstack([points, single])
    reconstruction = Reconstruction(
        tuple(registered[:3]), everything, np.zeros(len(everything)), MetricScale(1, 0.01, 3, True)
    )
    report = MappingReport(
        {names[3]: ImageReason.NO_VERIFIED_MATCHES.because()},
        {f"{names[0]} {names[3]}": ImageReason.NO_POSE.because()},
        {"total": 1.0},
    )
    return Solved(
        MappingProblem(tuple(problem_images)), MappingResult((reconstruction,), report), views
    )


def _surface_points(scene, pose, rng: np.random.Generator) -> np.ndarray:
    """Return world points in the middle of a view, which the neighboring views see too."""
    xy = rng.uniform([50, 35], [110, 85], (40, 2))
    return scene.sample(CAMERA, pose, xy).points
