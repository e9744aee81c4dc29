"""What matches say of a pose, and the pose that they support most."""

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
    """The first two of three views stand at their true poses."""
    problem = make_mapping_problem(
        room_scene(), CAMERA, POSES, noise=SyntheticNoise(keypoints_px=0.3)
    )
    scene = Scene(problem)
    for image in range(NEW):
        scene.register(image, POSES[image][:, :3], POSES[image][:, 3])
        scene.maps[image].set_scale(1.0)
    return scene


@pytest.fixture
def found(scene: Scene) -> PoseCorrespondences:
    """Every fifth match is wrong: its keypoint belongs to that of another match."""
    right = find_correspondences(scene, NEW, list(range(NEW)), OPTIONS)
    assert len(right.keypoints) > 50
    keypoints = right.keypoints.copy()
    keypoints[::5] = np.roll(keypoints[::5], 1)
    return right._replace(keypoints=keypoints)


def off_by(degrees: float) -> tuple[Float64, Float64]:
    """The true pose of the new view, turned about its own centre."""
    turn = Rotation.from_euler("xyz", [degrees, -degrees, degrees], degrees=True).as_matrix()
    return turn @ POSES[NEW][:, :3], turn @ POSES[NEW][:, 3]


def rated(scene: Scene, found: PoseCorrespondences, degrees: float) -> ScoredPose:
    return score_pose(scene, found, PoseHypothesis(*off_by(degrees), "PnP"), OPTIONS)


@pytest.mark.parametrize("degrees", [0.3, 1.5])
def test_a_pose_moves_to_where_matches_support_it_most(
    scene: Scene, found: PoseCorrespondences, degrees: float
) -> None:
    start = rated(scene, found, degrees)
    improved = maximize_support(scene, found, start, OPTIONS)
    assert improved.support >= 0.99 * rated(scene, found, 0.0).support > start.support
    assert rotation_angle_deg(improved.rotation @ POSES[NEW][:, :3].T) < 0.1
    assert improved.source == "PnP"
    assert 0.75 < improved.inlier_ratio < 0.85, "one in five is wrong"


def test_without_matches_it_stays(scene: Scene, found: PoseCorrespondences) -> None:
    none = found.select(np.zeros(len(found.keypoints), dtype=np.bool_))
    start = rated(scene, none, 1.0)
    assert start.support == start.num_inliers == start.inlier_ratio == 0
    assert maximize_support(scene, none, start, OPTIONS) is start


def test_a_depth_that_denies_the_new_images_prior_is_no_support(
    scene: Scene, found: PoseCorrespondences
) -> None:
    """Halving the distance to every third point leaves its pixel in place, but not its depth."""
    center = -POSES[NEW][:, :3].T @ POSES[NEW][:, 3]
    nearer = np.arange(len(found.keypoints)) % 3 == 0

    def moved(points: Float64) -> Float64:
        return np.where(nearer[:, None], center + 0.5 * (points - center), points)

    wrong = found._replace(
        points=moved(found.points),
        near_points=moved(found.near_points),
        far_points=moved(found.far_points),
    )
    before, after = rated(scene, found, 0.0), rated(scene, wrong, 0.0)
    assert after.num_inliers <= 0.75 * before.num_inliers
