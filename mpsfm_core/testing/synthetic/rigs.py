"""Synthetic mapping problems of rigs: stereo, two phones, cameras around, and panoramas."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera, Pose, Rig
from mpsfm_core.geometry import camera_center, compose, inside
from mpsfm_core.geometry.panorama import make_view_rotations
from mpsfm_core.testing.synthetic.problems import (
    SyntheticNoise,
    make_verified_pair,
    render_mapping_image,
)
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, project

RigKind = Literal["stereo", "phones", "around", "panorama"]

_MIN_MATCHES = 15
"""Minimum number of matches of a verified pair."""
_NORMAL_STD_DEG = 1.0
"""Angular std that the normal priors declare, in degrees."""


class RigProblem(NamedTuple):
    """Mapping problem with one rig, and its true poses."""

    problem: MappingProblem
    poses: list[Float64]
    """True pose ``cam_from_world`` (3, 4) of each image, with translations in meters."""


def make_rig_sensors(kind: RigKind) -> tuple[Pose, ...]:
    """Return ``sensor_from_rig`` of the sensors of a rig.

    Args:
        kind: Two parallel cameras 0.2 m apart (``stereo``), an upright phone and another phone with
            wide images at 0.15 m and 10 degrees to it (``phones``), four cameras with 0.1 m
            distance to the center that look outward (``around``), or eight views of a panorama
            with one center, at 45 degrees to each other (``panorama``).
    """
    if kind == "stereo":
        return ((np.eye(3), np.zeros(3)), (np.eye(3), np.array([-0.2, 0.0, 0.0])))
    if kind == "phones":
        turn = make_view_rotations(36)[1]
        return ((np.eye(3), np.zeros(3)), (turn, -turn @ [0.15, 0.02, 0.0]))
    count, distance = (4, 0.1) if kind == "around" else (8, 0.0)
    shift = np.array([0.0, 0.0, -distance])
    return tuple((rotation, shift) for rotation in make_view_rotations(count))


def _make_cameras(kind: RigKind) -> tuple[PinholeCamera, ...]:
    """Return the cameras of the sensors of a rig, or the one camera of all sensors."""
    if kind == "phones":
        return (
            PinholeCamera(480, 640, 460.0, 460.0, 240.0, 320.0),
            PinholeCamera(640, 480, 540.0, 540.0, 320.0, 240.0),
        )
    focal = 320.0 if kind == "panorama" else 400.0
    return (PinholeCamera(640, 640, focal, focal, 320.0, 320.0),)


def make_rig_problem(
    scene: AnalyticScene,
    kind: RigKind,
    frame_poses: Sequence[Float64],
    *,
    num_points: int = 1500,
    noise: SyntheticNoise | None = None,
    declared_depth_std: float = 0.02,
    map_width: int = 80,
    seed: int = 0,
) -> RigProblem:
    """Create the mapping problem of a moving rig, whose images have exact relative poses.

    Args:
        scene: Scene to render.
        kind: See :func:`make_rig_sensors`.
        frame_poses: Pose ``frame_from_world`` (3, 4) of each frame.
        num_points: Number of surface points, at random directions from random frames. Each view
            that sees a surface point has a keypoint, and all views with this keypoint match.
        noise: Standard deviations of the errors of keypoints and depth, by default zero.
        declared_depth_std: Relative std that the depth priors declare.
        map_width: Width of the prior maps in pixels.
        seed: Seed of the surface points and of noise.
    """
    noise = noise or SyntheticNoise()
    rng = np.random.default_rng(seed)
    sensors, cameras = make_rig_sensors(kind), _make_cameras(kind)
    poses = [
        np.column_stack(compose(sensor, (pose[:, :3], pose[:, 3])))
        for pose in frame_poses
        for sensor in sensors
    ]
    points = _sample_points(scene, frame_poses, num_points, rng)
    camera_of = [cameras[row % len(cameras)] for row in range(len(poses))]
    seen = [
        _find_visible(scene, camera, pose, points)
        for camera, pose in zip(camera_of, poses, strict=True)
    ]
    names = [
        tuple(f"camera{sensor}/{frame:04d}.png" for sensor in range(len(sensors)))
        for frame in range(len(frame_poses))
    ]
    images = tuple(
        render_mapping_image(
            name,
            scene,
            camera,
            pose,
            xy + noise.keypoints_px * rng.normal(size=xy.shape),
            map_width,
            declared_depth_std,
            _NORMAL_STD_DEG,
            noise,
            rng,
        )
        for name, camera, pose, (_, xy) in zip(
            np.ravel(names).tolist(), camera_of, poses, seen, strict=True
        )
    )
    pairs = []
    for a, b in combinations(range(len(poses)), 2):
        _, rows_a, rows_b = np.intersect1d(seen[a][0], seen[b][0], return_indices=True)
        if len(rows_a) >= _MIN_MATCHES:
            pairs.append(make_verified_pair(a, b, np.stack([rows_a, rows_b], axis=1), poses))
    return RigProblem(MappingProblem(images, tuple(pairs), (Rig(sensors, tuple(names)),)), poses)


def _sample_points(
    scene: AnalyticScene, frame_poses: Sequence[Float64], count: int, rng: np.random.Generator
) -> Float64:
    """Sample surface points (n, 3) at random directions from the centers of random frames."""
    directions = rng.normal(size=(count, 3))
    frames = rng.integers(len(frame_poses), size=count)
    points = np.zeros((count, 3))
    for frame, pose in enumerate(frame_poses):
        rows = frames == frame
        center = camera_center(pose[:, :3], pose[:, 3])
        distance, _, _ = scene.first_hit(center, directions[rows])
        points[rows] = center + distance[:, None] * directions[rows]
    return points


def _find_visible(
    scene: AnalyticScene, camera: PinholeCamera, pose: Float64, points: Float64
) -> tuple[np.ndarray, Float64]:
    """Return the indices (m,) of the points that a view sees, and their pixels (m, 2)."""
    xy, depth = project(camera, pose, points)
    rows = np.flatnonzero((depth > 0) & inside(xy, camera.size))
    center = camera_center(pose[:, :3], pose[:, 3])
    t, _, _ = scene.first_hit(center, points[rows] - center)
    rows = rows[np.abs(t - 1.0) < 1e-6]
    return rows, xy[rows]
