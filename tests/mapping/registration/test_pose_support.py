"""Tests of the support of a pose by correspondences, and of maximizing the support."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesis
from mpsfm_core.mapping.registration.pose_support import ScoredPose, maximize_support, score_pose
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
POSES = arc_poses(3, 14.0)
NEW = 2
OPTIONS = RegistrationOptions()


@pytest.fixture
def scene() -> Scene:
    """Two of three images are registered at their true poses."""
    problem = make_mapping_problem(
        room_scene(), CAMERA, POSES, noise=SyntheticNoise(keypoints_px=0.3)
    )
    scene = Scene(problem)
    for image in range(NEW):
        scene.register(image, POSES[image][:, :3], POSES[image][:, 3])
        scene.maps[image].set_scale(1.0)
    return scene


@pytest.fixture
def correspondences(scene: Scene) -> PoseCorrespondences:
    """Return correspondences of which every fifth has the keypoint of another correspondence."""
    right = find_correspondences(scene, NEW, list(range(NEW)), OPTIONS)
    assert len(right.keypoints) > 50
    keypoints = right.keypoints.copy()
    keypoints[::5] = np.roll(keypoints[::5], 1)
    return right._replace(keypoints=keypoints)


def perturbed_pose(degrees: float) -> tuple[Float64, Float64]:
    """Return the true pose of the new image, rotated about its center."""
    turn = Rotation.from_euler("xyz", [degrees, -degrees, degrees], degrees=True).as_matrix()
    return turn @ POSES[NEW][:, :3], turn @ POSES[NEW][:, 3]


def rated(scene: Scene, correspondences: PoseCorrespondences, degrees: float) -> ScoredPose:
    return score_pose(
        scene, correspondences, PoseHypothesis(*perturbed_pose(degrees), "PnP"), OPTIONS
    )


@pytest.mark.parametrize("degrees", [0.3, 1.5])
def test_maximize_support_from_perturbed_pose_reaches_true_pose(
    scene: Scene, correspondences: PoseCorrespondences, degrees: float
) -> None:
    start = rated(scene, correspondences, degrees)
    improved = maximize_support(scene, correspondences, start, OPTIONS)
    assert improved.support >= 0.99 * rated(scene, correspondences, 0.0).support > start.support
    assert rotation_angle_deg(improved.rotation @ POSES[NEW][:, :3].T) < 0.1
    assert improved.source == "PnP"
    assert 0.75 < improved.inlier_ratio < 0.85, "one in five is wrong"


def test_maximize_support_without_correspondences_returns_pose(
    scene: Scene, correspondences: PoseCorrespondences
) -> None:
    none = correspondences.select(np.zeros(len(correspondences.keypoints), dtype=np.bool_))
    start = rated(scene, none, 1.0)
    assert start.support == start.num_inliers == start.inlier_ratio == 0
    assert maximize_support(scene, none, start, OPTIONS) is start


def test_score_pose_with_inconsistent_depth_counts_fewer_inliers(
    scene: Scene, correspondences: PoseCorrespondences
) -> None:
    """Halving the distance to every third point changes its depth but not its projection."""
    center = -POSES[NEW][:, :3].T @ POSES[NEW][:, 3]
    nearer = np.arange(len(correspondences.keypoints)) % 3 == 0

    def moved(points: Float64) -> Float64:
        return np.where(nearer[:, None], center + 0.5 * (points - center), points)

    wrong = correspondences._replace(
        points=moved(correspondences.points),
        near_points=moved(correspondences.near_points),
        far_points=moved(correspondences.far_points),
    )
    before, after = rated(scene, correspondences, 0.0), rated(scene, wrong, 0.0)
    assert after.num_inliers <= 0.75 * before.num_inliers
