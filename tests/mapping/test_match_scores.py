"""Tests of match scores as weights of correspondences and keypoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesis
from mpsfm_core.mapping.registration.pose_support import score_pose
from mpsfm_core.mapping.scene.graph import MIN_SCORE, CorrespondenceGraph
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
POSES = arc_poses(3, 14.0)


def problem_with_inaccurate_matches(seed: int = 0) -> MappingProblem:
    """Return a problem with two-view tracks and low scores of inaccurate matches.

    Three of four keypoints have noise of 2 px (standard deviation), and their matches a low score.
    """
    problem = make_mapping_problem(
        room_scene(),
        CAMERA,
        POSES,
        noise=SyntheticNoise(keypoints_px=0.1),
        two_view_tracks=True,
        seed=seed,
    )
    rng = np.random.default_rng(seed)
    inaccurate = [np.arange(len(image.keypoints)) % 4 > 0 for image in problem.images]
    images = []
    for image, off in zip(problem.images, inaccurate, strict=True):
        keypoints = image.keypoints.copy()
        keypoints[off] += rng.normal(0, 2, (off.sum(), 2))
        images.append(replace(image, keypoints=keypoints, keypoint_std_px=1.0))
    pairs = []
    for pair in problem.pairs:
        off = (
            inaccurate[pair.image_a][pair.matches[:, 0]]
            | inaccurate[pair.image_b][pair.matches[:, 1]]
        )
        pairs.append(replace(pair, scores=np.where(off, 0.1, 1.0).astype(np.float32)))
    return MappingProblem(tuple(images), tuple(pairs))


def pose_errors_deg(problem: MappingProblem, *, weigh_by_score: bool) -> list[float]:
    """Return rotation and direction errors of all images relative to the first."""
    # A measured keypoint noise would compensate a part of the weights.
    refinement = {"measure_keypoint_noise": False}
    options = {"weigh_by_score": weigh_by_score, "refinement": refinement}
    result = reconstruct(problem, MapperOptions.model_validate(options))
    first, *others = result.reconstructions[0].images
    assert len(others) == len(POSES) - 1
    errors = []
    for image, pose in zip(others, POSES[1:], strict=True):
        rotation = image.rotation @ first.rotation.T
        true_rotation = pose[:, :3] @ POSES[0][:, :3].T
        direction = image.translation - rotation @ first.translation
        true_direction = pose[:, 3] - true_rotation @ POSES[0][:, 3]
        turn = float(rotation_angle_deg(rotation @ true_rotation.T))
        errors += [turn, float(angle_between_deg(direction, true_direction))]
    return errors


def test_match_scores_reduce_pose_errors() -> None:
    weighted: list[float] = []
    unweighted: list[float] = []
    for seed in range(6):
        problem = problem_with_inaccurate_matches(seed)
        weighted += pose_errors_deg(problem, weigh_by_score=True)
        unweighted += pose_errors_deg(problem, weigh_by_score=False)
    assert np.mean(weighted) < 0.75 * np.mean(unweighted)


def test_keypoint_weight_is_best_score_relative_to_mean() -> None:
    problem = problem_with_inaccurate_matches()
    graph = CorrespondenceGraph(problem)
    best = np.zeros(len(graph.image_of))
    for pair in problem.pairs:
        for image, rows in ((pair.image_a, pair.matches[:, 0]), (pair.image_b, pair.matches[:, 1])):
            keypoints = graph.offsets[image] + rows
            best[keypoints] = np.maximum(best[keypoints], pair.scores)
    mean = np.concatenate([pair.scores for pair in problem.pairs]).mean()
    np.testing.assert_allclose(graph.keypoint_weight, best / mean, rtol=1e-6)


def test_adjusted_keypoints_are_weighted_by_variance() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, POSES)
    factor = np.ones(problem.num_keypoints(1))
    factor[::2] = 0.25
    images = list(problem.images)
    images[1] = replace(images[1], keypoint_std_factor=factor)
    before, after = (
        CorrespondenceGraph(each) for each in (problem, replace(problem, images=tuple(images)))
    )
    ratio = after.keypoint_weight / np.where(before.keypoint_weight, before.keypoint_weight, np.nan)
    seen = before.keypoint_weight > 0
    expected = np.ones(len(seen))
    expected[before.keypoints_of(1)] = factor**-2
    np.testing.assert_allclose(ratio[seen], expected[seen])


@pytest.mark.parametrize("score", [0.0, 0.3, 1.0])
def test_equal_scores_give_unit_weights(score: float) -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, POSES)
    equal = MappingProblem(
        problem.images,
        tuple(
            replace(pair, scores=np.full(len(pair), score, dtype=np.float32))
            for pair in problem.pairs
        ),
    )
    weighted = CorrespondenceGraph(equal)
    unweighted = CorrespondenceGraph(equal, weigh_by_score=False)
    assert (weighted.score >= MIN_SCORE).all()
    np.testing.assert_allclose(weighted.keypoint_weight, unweighted.keypoint_weight, rtol=1e-6)


def test_support_and_inlier_ratio_are_weighted_and_num_inliers_is_not() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, POSES)
    scene = Scene(problem)
    count = 10
    keypoints = np.arange(count) + scene.graph.offsets[1]
    points = scene.rays(keypoints) * 2.0  # image 1 is at the origin, so the residuals are 0
    points[6:, 0] += 1.0  # outliers
    scores = np.where(np.arange(count) < 6, 0.9, 0.1)
    references, known = np.zeros(count, dtype=np.int64), np.ones(count, dtype=np.bool_)
    correspondences = PoseCorrespondences(
        1, keypoints, keypoints, points, points, points, references, known, scores
    )
    options = RegistrationOptions(max_depth_deviation=1e6)
    pose = score_pose(
        scene, correspondences, PoseHypothesis(np.eye(3), np.zeros(3), "PnP"), options
    )
    assert pose.num_inliers == 6
    assert pose.support == pytest.approx(5.4)
    assert pose.inlier_ratio == pytest.approx(5.4 / 5.8)
