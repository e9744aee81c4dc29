"""Tests of the localization of frames between keyframes with true depth, and of smoothing."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import DepthPrior, PinholeCamera
from mpsfm_core.data.decisions import FrameReason, Reason
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.mapping.frame_localization import (
    FrameCamera,
    FramePose,
    Keyframe,
    localize_frame,
)
from mpsfm_core.mapping.trajectory_smoothing import interpolate_pose, smooth_trajectory
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(200, 150, 160.0, 160.0, 100.0, 75.0)
POSES = [(pose[:, :3], pose[:, 3]) for pose in map(np.asarray, arc_poses(3, 4.0))]


@pytest.fixture(scope="module")
def views() -> list[tuple[np.ndarray, DepthPrior]]:
    """Return gray image and true depth of three views that turn by 4 degrees each."""
    scene, found = room_scene(), []
    for rotation, translation in POSES:
        view = scene.render(CAMERA, np.column_stack([rotation, translation]))
        gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
        variance = (0.01 * view.depth) ** 2
        found.append((gray, DepthPrior(view.depth, variance, view.depth > 0)))
    return found


def build(views, row: int) -> Keyframe:
    gray, depth = views[row]
    camera = FrameCamera(CAMERA, lambda xy: xy, lambda xy: xy)
    none = np.zeros((0, 2)), np.zeros((0, 3))
    return Keyframe.build(gray, camera, POSES[row], none, depth)


def test_frame_between_keyframes_gets_its_true_pose(views) -> None:
    keyframes = [build(views, 0), build(views, 2)]
    found = localize_frame(keyframes, views[1][0], interpolate_pose(POSES[0], POSES[2], 0.3))
    assert isinstance(found, FramePose)
    assert found.num_inliers > 100
    assert rotation_angle_deg(found.pose[0] @ POSES[1][0].T) < 0.1
    error = np.linalg.norm(camera_center(*found.pose) - camera_center(*POSES[1]))
    assert error < 0.01
    assert 0 < np.sqrt(np.trace(found.covariance[3:, 3:])) < 0.05


def test_frame_of_noise_gets_a_reason(views) -> None:
    noise = np.random.default_rng(0).integers(0, 255, views[0][0].shape, dtype=np.uint8)
    found = localize_frame([build(views, 0)], noise, POSES[0])
    assert isinstance(found, Reason)
    assert found.code in (FrameReason.TOO_FEW_TRACKS, FrameReason.TOO_FEW_INLIERS)


def make_walk(count: int) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return times and smooth true poses of a walk."""
    times = np.arange(count) / 30
    poses = []
    for time in times:
        turn = np.array([0.3 * np.sin(time), 0.3 * time, 0.1 * np.cos(2 * time)])
        rotation = pycolmap.Rotation3d(turn).matrix()
        center = np.array([time, np.sin(time), 0.2 * np.cos(3 * time)])
        poses.append((rotation, -rotation @ center))
    return times, poses


def test_smoothing_halves_noise_and_fills_gaps_with_larger_std() -> None:
    rng = np.random.default_rng(0)
    times, true = make_walk(150)
    std = np.array([*[0.001] * 3, *[0.01] * 3])
    measured = []
    for number, (rotation, translation) in enumerate(true):
        noise = rng.normal(0, std)
        turned = pycolmap.Rotation3d(noise[:3]).matrix() @ rotation
        is_gap = 60 <= number < 70
        measured.append(None if is_gap else ((turned, translation + noise[3:]), np.diag(std**2)))
    smoothed = smooth_trajectory(times, measured)

    def errors(poses) -> np.ndarray:
        return np.array([camera_center(*a) - camera_center(*b) for a, b in poses])

    kept = [(s.pose, t) for s, t, m in zip(smoothed, true, measured, strict=True) if m]
    raw = [(m[0], t) for t, m in zip(true, measured, strict=True) if m]
    assert errors(kept).std() < 0.6 * errors(raw).std()
    gap = errors([(smoothed[k].pose, true[k]) for k in range(60, 70)])
    spread = np.sqrt([np.diag(smoothed[k].covariance)[3:] for k in (40, 65)])
    assert np.abs(gap).max() < 0.04 and (spread[1] > 1.5 * spread[0]).all()
    assert np.abs(gap / spread[1]).max() < 3


def test_covariance_is_positive_with_frames_of_very_different_accuracy() -> None:
    times, true = make_walk(40)
    stds = [1e-7 if number % 8 == 0 else 1e-2 for number in range(40)]
    measured = [(pose, np.eye(6) * std**2) for pose, std in zip(true, stds, strict=True)]
    smoothed = smooth_trajectory(times, measured)
    assert all(np.linalg.eigvalsh(frame.covariance).min() > 0 for frame in smoothed)
