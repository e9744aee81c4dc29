"""Tests of the initial pair: reference image, relaxed thresholds, and ranking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Bool, MappingProblem, PinholeCamera
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg
from mpsfm_core.mapping.initialization.initial_pair import InitialPairSelector, rank_initial_pairs
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.image_selection import compute_pair_scores
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
POSES = arc_poses(2, 14.0)


def pair_problem(matches: int | None = None) -> MappingProblem:
    """Return a problem of two images with the first matches only."""
    problem = make_mapping_problem(room_scene(), CAMERA, POSES)
    (pair,) = problem.pairs
    return replace(
        problem,
        pairs=(replace(pair, matches=pair.matches[:matches], scores=pair.scores[:matches]),),
    )


def without_depth(problem: MappingProblem, image: int, columns: slice) -> MappingProblem:
    """Return the problem with unknown depth in some columns of an image."""
    images = list(problem.images)
    valid: Bool = images[image].depth.valid.copy()
    valid[:, columns] = False
    images[image] = replace(images[image], depth=replace(images[image].depth, valid=valid))
    return replace(problem, images=tuple(images))


def error_deg(result: MappingResult) -> float:
    """Return the error of the relative pose: rotation or direction, whichever is larger."""
    a, b = result.reconstructions[0].images
    rotation = b.rotation @ a.rotation.T
    translation = b.translation - rotation @ a.translation
    true_rotation = POSES[1][:, :3] @ POSES[0][:, :3].T
    true_translation = POSES[1][:, 3] - true_rotation @ POSES[0][:, 3]
    turn = float(rotation_angle_deg(rotation @ true_rotation.T))
    return max(turn, float(angle_between_deg(translation, true_translation)))


@pytest.mark.parametrize("image", [0, 1])
def test_image_with_more_depth_is_reference(image: int) -> None:
    problem = without_depth(pair_problem(), image, slice(10, None))
    assert error_deg(reconstruct(problem)) < 0.1


def test_pair_with_few_matches_initializes_at_relaxed_thresholds() -> None:
    assert error_deg(reconstruct(pair_problem(15))) < 1.0
    strict = MapperOptions.model_validate({"registration": {"max_relaxations": 0}})
    result = reconstruct(pair_problem(15), strict)
    assert not result.reconstructions
    reason = result.report.pair_reasons["view_0.png view_1.png"]
    assert reason.values["min_inliers"] == 30


def test_without_lifting_verified_pose_initializes() -> None:
    options = MapperOptions.model_validate({"registration": {"lifting": False}})
    assert error_deg(reconstruct(pair_problem(), options)) < 0.1


def test_pair_with_wrong_matches_is_rejected() -> None:
    problem = pair_problem()
    (pair,) = problem.pairs
    shuffled = np.random.default_rng(0).permutation(pair.matches[:, 1])
    matches = np.stack([pair.matches[:, 0], shuffled], axis=1)
    wrong = replace(problem, pairs=(replace(pair, matches=matches, calibrated=False),))
    assert not reconstruct(wrong).reconstructions


def test_rank_pairs_orders_largest_pairs_by_support() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    rng = np.random.default_rng(0)
    pairs = list(problem.pairs)
    largest = max(range(3), key=lambda k: len(pairs[k]))
    for k, pair in enumerate(pairs):
        matches, count = pair.matches.copy(), len(pairs[largest]) * 2 // 3
        if k == largest:
            wrong = rng.permutation(len(matches))[: int(0.6 * len(matches))]
            matches[wrong, 1] = rng.permutation(matches[wrong, 1])
            count = len(matches)
        pairs[k] = replace(pair, matches=matches[:count], scores=pair.scores[:count])
    wrong_pair = pairs[largest]
    options, selector = MapperOptions(), InitialPairSelector(MapperOptions())
    scene = Scene(replace(problem, pairs=tuple(pairs)))
    refiner = Refiner(scene, options, compute_pair_scores(scene))
    pose_estimator = AbsolutePoseEstimator(scene, refiner, options)
    assert rank_initial_pairs(scene)[0] is wrong_pair
    assert selector.rank_pairs(pose_estimator, np.ones(3, dtype=np.bool_))[-1] is wrong_pair
    candidates = np.isin(np.arange(3), [wrong_pair.image_a, wrong_pair.image_b])
    assert selector.rank_pairs(pose_estimator, candidates) == [wrong_pair]
