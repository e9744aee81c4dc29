"""Tests of two-view verification against COLMAP and against known geometry."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.decisions import PairReason
from mpsfm_core.extraction.matching.verification import verify_matches
from mpsfm_core.extraction.options import VerificationOptions
from mpsfm_core.geometry import angle_between_deg, compose, invert, rotation_angle_deg
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, Plane, arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 500.0, 510.0, 318.0, 243.0)
OTHER = PinholeCamera(480, 640, 450.0, 450.0, 240.0, 320.0)
POSES = arc_poses(2, 15.0)


def relative_pose(poses=POSES) -> tuple[np.ndarray, np.ndarray]:
    a, b = ((pose[:, :3], pose[:, 3]) for pose in poses)
    return compose(b, invert(*a))


def correspondences(scene: AnalyticScene, count: int, noise: float, camera_b=CAMERA, poses=POSES):
    rng = np.random.default_rng(count)
    xy = rng.uniform(0, 1, (3 * count, 2)) * CAMERA.size
    found = scene.correspondences(CAMERA, poses[0], camera_b, poses[1], xy)
    rows = np.flatnonzero(found.visible)[:count]
    assert len(rows) == count
    return xy[rows], found.xy_b[rows] + rng.normal(0, noise, (count, 2))


def add_outliers(xy_a: np.ndarray, xy_b: np.ndarray, count: int, camera=CAMERA):
    rng = np.random.default_rng(5)
    rows = rng.choice(len(xy_a), count, replace=False)
    xy_b = xy_b.copy()
    xy_b[rows] = rng.uniform(0, 1, (count, 2)) * camera.size
    good = np.ones(len(xy_a), dtype=np.bool_)
    good[rows] = False
    return xy_a, xy_b, good


@pytest.mark.parametrize("camera_b", [CAMERA, OTHER])
def test_verify_matches_recovers_pose_and_inliers(camera_b) -> None:
    points = correspondences(room_scene(), 300, 0.5, camera_b)
    xy_a, xy_b, good = add_outliers(*points, 100, camera_b)
    found = verify_matches(CAMERA, camera_b, xy_a, xy_b, VerificationOptions())
    rotation, translation = relative_pose()
    assert (found.dropped, found.configuration) == ("", "calibrated")
    assert rotation_angle_deg(found.rotation @ rotation.T) < 0.3
    assert angle_between_deg(found.translation, translation) < 1.5
    assert np.linalg.norm(found.translation) == pytest.approx(1)
    kept = np.zeros(len(xy_a), dtype=np.bool_)
    kept[found.inliers] = True
    assert kept[good].mean() > 0.99
    assert kept[~good].mean() < 0.15  # a few outliers are near their epipolar line by chance


def test_verify_matches_equals_colmap() -> None:
    xy_a, xy_b, _ = add_outliers(*correspondences(room_scene(), 200, 0.5), 80)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.max_num_trials = 20_000
    options.ransac.min_inlier_ratio = 0.1
    options.ransac.random_seed = 3
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=CAMERA.params)
    matches = np.column_stack([np.arange(200), np.arange(200)]).astype(np.uint32)
    expected = pycolmap.estimate_calibrated_two_view_geometry(
        camera, xy_a, camera, xy_b, matches, options
    )
    found = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions(), seed=3)
    configuration = pycolmap.TwoViewGeometryConfiguration(expected.config)
    assert found.configuration == configuration.name.lower() == "calibrated"
    assert found.inliers.tolist() == expected.inlier_matches[:, 0].tolist()
    assert np.array_equal(found.rotation, expected.cam2_from_cam1.rotation.matrix())
    assert np.array_equal(found.translation, expected.cam2_from_cam1.translation)


def test_verify_matches_is_deterministic() -> None:
    xy_a, xy_b, _ = add_outliers(*correspondences(room_scene(), 150, 1.0), 90)
    first, second = (
        verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions(), seed=1) for _ in range(2)
    )
    assert first.inliers.tolist() == second.inliers.tolist()
    assert np.array_equal(first.rotation, second.rotation)


def test_verify_matches_of_planar_scene() -> None:
    wall = AnalyticScene((Plane((4.0, 0.0, 0.0), (1.0, 0.2, 0.0)),))
    xy_a, xy_b = correspondences(wall, 100, 0.3)
    found = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions())
    assert found.configuration in ("planar", "planar or panoramic")
    assert len(found.inliers) > 90
    assert rotation_angle_deg(found.rotation @ relative_pose()[0].T) < 5


@pytest.mark.parametrize("angle_deg", [1.0, 1.5])
def test_verify_matches_of_low_parallax(angle_deg: float) -> None:
    """COLMAP classifies a room at low parallax as planar, and its translation is wrong."""
    poses = arc_poses(2, angle_deg)
    xy_a, xy_b = correspondences(room_scene(), 400, 0.4, poses=poses)
    camera = colmap_from_pinhole(CAMERA)
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    options.ransac.random_seed = 0
    rows = np.column_stack([np.arange(400), np.arange(400)]).astype(np.uint32)
    colmap = pycolmap.estimate_calibrated_two_view_geometry(
        camera, xy_a, camera, xy_b, rows, options
    )
    assert colmap.config == pycolmap.TwoViewGeometryConfiguration.PLANAR
    found = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions())
    rotation, translation = relative_pose(poses)
    assert angle_between_deg(colmap.cam2_from_cam1.translation, translation) > 10
    assert (found.configuration, len(found.inliers)) == ("calibrated", 400)
    assert rotation_angle_deg(found.rotation @ rotation.T) < 0.1
    assert angle_between_deg(found.translation, translation) < 1.5


def test_verify_matches_of_pure_rotation() -> None:
    angle = np.radians(10)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (80, 2)), rng.uniform(3, 6, 80)])
    xy_a, xy_b = (
        (p[:, :2] / p[:, 2:]) * [500, 510] + [318, 243] for p in (points, points @ turn.T)
    )
    found = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions())
    assert found.configuration == "panoramic"
    assert rotation_angle_deg(found.rotation @ turn.T) < 0.1
    assert np.linalg.norm(found.translation) < 1e-6


def test_verify_matches_drops_pair_with_too_few_matches() -> None:
    xy = np.zeros((14, 2))
    found = verify_matches(CAMERA, CAMERA, xy, xy, VerificationOptions())
    assert found.drop_reason(14, 15) == PairReason.TOO_FEW_MATCHES.because(
        num_matches=14, min_matches=15
    )
    assert not len(found.inliers)
    assert verify_matches(CAMERA, CAMERA, xy[:0], xy[:0], VerificationOptions()).dropped


@pytest.mark.parametrize("count", [20, 40, 250])
def test_verify_matches_drops_random_matches(count: int) -> None:
    """Random matches are dropped even if many fit some epipolar geometry by chance."""
    rng = np.random.default_rng(count)
    xy_a, xy_b = rng.uniform(0, 1, (2, count, 2)) * CAMERA.size
    dropped = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions())
    assert dropped.dropped and not len(dropped.inliers)
    if count > 100:
        lenient = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions(max_chance=1.0))
        assert not lenient.dropped  # min_inliers alone accepts the pair
        assert dropped.dropped == PairReason.EXPLAINED_BY_CHANCE.value


def test_inlier_threshold_scales_with_keypoint_std() -> None:
    xy_a, xy_b = correspondences(room_scene(), 200, 6.0)
    sharp = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions())
    wide = verify_matches(CAMERA, CAMERA, xy_a, xy_b, VerificationOptions(), std_px=4.0)
    assert len(wide.inliers) > 180 > len(sharp.inliers)
