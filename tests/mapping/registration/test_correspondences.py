"""Tests of pose correspondences of keypoints with unknown depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mpsfm_core.data import DepthPrior, MappingProblem, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import (
    RAY_MATCH_WEIGHT,
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.pose_estimation import estimate_candidate_poses
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesis
from mpsfm_core.mapping.registration.pose_support import score_pose
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
POSES = arc_poses(2, 14.0)
TRUTH = PoseHypothesis(POSES[1][:, :3], POSES[1][:, 3], "truth")
OPTIONS = RegistrationOptions()
Part = tuple[slice, slice]
NOWHERE: Part = (slice(0), slice(0))
EVERYWHERE: Part = (slice(None), slice(None))
LEFT_HALF: Part = (slice(None), slice(80))
STRIPS: Mapping[str, Part] = {
    "left": (slice(None), slice(40)),
    "right": (slice(None), slice(-40, None)),
    "top": (slice(30), slice(None)),
    "bottom": (slice(-30, None), slice(None)),
}
"""Parts of a depth map of 160 x 120 pixels, each a quarter of it."""


def scene_with_depth_in(part: Part, seed: int = 0) -> Scene:
    """Return two images, the first registered, with depth in one part and no relative pose."""
    noise = SyntheticNoise(keypoints_px=0.7, depth=0.01)
    problem = make_mapping_problem(room_scene(), CAMERA, POSES, noise=noise, seed=seed)
    images = []
    for image in problem.images:
        depth = image.depth
        known = np.zeros(depth.shape, dtype=np.bool_)
        known[part] = True
        prior = DepthPrior.from_arrays(depth.depth, depth.variance, depth.valid & known)
        images.append(replace(image, depth=prior))
    pairs = [replace(pair, rotation=np.eye(3), calibrated=False) for pair in problem.pairs]
    scene = Scene(MappingProblem(tuple(images), tuple(pairs)))
    scene.register(0, POSES[0][:, :3], POSES[0][:, 3])
    scene.maps[0].set_scale(1.0)
    return scene


def error_deg(scene: Scene, correspondences: PoseCorrespondences) -> float:
    """Return the rotation error of the best pose."""
    best = estimate_candidate_poses(scene, correspondences, OPTIONS, seed=0, attempt=0)[0]
    return float(rotation_angle_deg(best.rotation @ TRUTH.rotation.T))


def test_unknown_depth_spans_known_depth_range_of_image() -> None:
    scene = scene_with_depth_in(LEFT_HALF)
    correspondences = find_correspondences(scene, 1, [0], OPTIONS)
    depth_map = scene.maps[0]
    rows = correspondences.matched_keypoints - scene.graph.offsets[0]
    np.testing.assert_array_equal(correspondences.depth_known, depth_map.keypoint_valid[rows])
    rays = ~correspondences.depth_known
    assert 20 < rays.sum() < len(rays) - 20
    known = depth_map.at_keypoints()[depth_map.keypoint_valid]
    for ends, depth in (
        (correspondences.near_points, known.min()),
        (correspondences.far_points, known.max()),
    ):
        errors_px, z = scene.project(correspondences.matched_keypoints[rays], ends[rays])
        np.testing.assert_allclose(z, depth)
        assert errors_px.max() < 1e-9, "on the ray of the keypoint"


def test_matches_of_unknown_depth_have_half_weight() -> None:
    scene = scene_with_depth_in(LEFT_HALF)
    correspondences = find_correspondences(scene, 1, [0], OPTIONS)
    everywhere = find_correspondences(scene_with_depth_in(EVERYWHERE), 1, [0], OPTIONS)
    np.testing.assert_array_equal(correspondences.keypoints, everywhere.keypoints)
    np.testing.assert_array_equal(
        correspondences.depth_weights, np.where(correspondences.depth_known, 1.0, RAY_MATCH_WEIGHT)
    )
    np.testing.assert_allclose(
        correspondences.weights / correspondences.depth_weights,
        everywhere.weights / everywhere.depth_weights,
    )
    pose = score_pose(scene, correspondences, TRUTH, OPTIONS)
    alone = score_pose(scene, correspondences.select(correspondences.depth_known), TRUTH, OPTIONS)
    rays = score_pose(scene, correspondences.select(~correspondences.depth_known), TRUTH, OPTIONS)
    assert rays.num_inliers >= 0.4 * RAY_MATCH_WEIGHT * (~correspondences.depth_known).sum()
    assert rays.num_inliers <= RAY_MATCH_WEIGHT * (~correspondences.depth_known).sum()
    assert alone.num_inliers <= pose.num_inliers <= alone.num_inliers + rays.num_inliers + 1


def test_image_without_depth_gives_no_correspondences() -> None:
    scene = scene_with_depth_in(NOWHERE)
    assert not len(find_correspondences(scene, 1, [0], OPTIONS).keypoints)


def test_without_lifting_untriangulated_matches_are_ignored() -> None:
    scene = scene_with_depth_in(LEFT_HALF)
    options = RegistrationOptions(lifting=False)
    assert not len(find_correspondences(scene, 1, [0], options).keypoints)


def test_matches_of_unknown_depth_reduce_rotation_error() -> None:
    with_rays, without = [], []
    for part in STRIPS.values():
        for seed in range(3):
            scene = scene_with_depth_in(part, seed)
            correspondences = find_correspondences(scene, 1, [0], OPTIONS)
            assert 0.15 < correspondences.depth_known.mean() < 0.35
            with_rays.append(error_deg(scene, correspondences))
            without.append(error_deg(scene, correspondences.select(correspondences.depth_known)))
    assert np.mean(with_rays) < 0.75 * np.mean(without)
