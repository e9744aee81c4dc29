"""Fixtures: result folders of an exact reconstruction, with photos of a distorted camera."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import DepthPrior, MappingImage, MappingProblem, NormalPrior, Rig
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.undistortion import undistort_camera
from mpsfm_core.mapping.scene.reconstruction import MetricScale, Reconstruction, RegisteredImage
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.writer import ComponentResult, write_results
from mpsfm_core.testing.synthetic.scenes import arc_poses, project, room_scene

CAMERA = pycolmap.Camera(
    model="OPENCV",
    width=160,
    height=120,
    params=[140, 141, 80, 60, 0.05, -0.01, 0.001, -0.002],
    camera_id=1,
)
NAMES = ("a/0.png", "a/1.jpg", "2.webp", "guess.png")


POSES = arc_poses(4, 12.0)


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write ``out/`` and ``photos/`` in room coordinates; the last image is tentatively
    registered."""
    return write_result(tmp_path_factory.mktemp("result"))


@pytest.fixture(scope="session")
def rig_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the same result, whose first two images are a frame of a rig."""
    first, second = (np.vstack([pose, [0, 0, 0, 1]]) for pose in POSES[:2])
    second_from_first = second @ np.linalg.inv(first)
    sensors = (np.eye(3), np.zeros(3)), (second_from_first[:3, :3], second_from_first[:3, 3])
    rig = Rig(sensors, (NAMES[:2], (NAMES[2], None)))
    return write_result(tmp_path_factory.mktemp("rig_result"), (rig,))


def write_result(folder: Path, rigs: tuple[Rig, ...] = ()) -> Path:
    """Write ``out/`` and ``photos/`` in room coordinates into a folder, and return ``out/``."""
    scene, poses = room_scene(), POSES
    pinhole = undistort_camera(CAMERA)
    points = scene.sample(
        pinhole, poses[0], np.random.default_rng(0).uniform([50, 35], [110, 85], (60, 2))
    ).points
    sources, registered, problem = [], [], []
    for index, (name, pose) in enumerate(zip(NAMES, poses, strict=True)):
        path = folder / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(scene.render(pinhole, pose).rgb, cv2.COLOR_RGB2BGR))
        picture = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.resize(picture, (160, 120)))
        sources.append(SourceImage(name, path, CAMERA, pinhole, "intrinsics", "0"))
        small = scene.render(pinhole.resized(80, 60), pose)
        ones = np.ones(small.depth.shape, np.float32)
        depth = DepthPrior(small.depth, (0.01 * small.depth) ** 2 + 1e-9 * ones, small.depth > 0)
        normals = NormalPrior.from_arrays(small.normals, 0.01 * ones)
        xy, _ = project(pinhole, pose, points)
        ids = np.arange(len(points))
        problem.append(MappingImage(name, pinhole, xy, depth, normals))
        registered.append(
            RegisteredImage(index, name, pinhole, pose[:, :3], pose[:, 3], ids, depth, 1.0)
        )
    registered[-1] = replace(registered[-1], confirmed=False)
    metric = MetricScale(1.0, 0.01, 4, True)
    best = Reconstruction(tuple(registered), points, np.zeros(len(points)), metric)
    best = replace(best, rigs=rigs)
    photos = OriginalImages(ImageSet(sources, InputOptions()), MappingProblem(tuple(problem)))
    component = ComponentResult.of(best, photos)
    summary = {
        "status": "success",
        "photos": str(folder / "photos"),
        "images": {"unconfirmed": {NAMES[-1]: "nothing confirms it"}},
        "reconstructions": [{"metric_scale": asdict(metric)}],
        "config": {"inputs": InputOptions().model_dump(mode="json")},
    }
    write_results(folder / "out", [component], photos, ResultOptions(), lambda: summary)
    assert json.loads((folder / "out" / "summary.json").read_text())["status"] == "success"
    return folder / "out"
