"""Tests of pair consistency: depth contradicts look-alike pairs but not correct pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera, VerifiedPair
from mpsfm_core.mapping.consistency.pair_consistency import (
    PairConsistency,
    PairConsistencyCheck,
    reweight_pairs,
)
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.image_selection import compute_pair_scores
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from mpsfm_core.testing.synthetic.two_rooms import make_twin_room_problem

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)

Check = TypeVar("Check", bound=PairConsistencyCheck)


def checker(problem: MappingProblem, kind: type[Check]) -> Check:
    options, scene = MapperOptions(), Scene(problem)
    refiner = Refiner(scene, options, compute_pair_scores(scene))
    return kind(AbsolutePoseEstimator(scene, refiner, options), options)


def test_check_pair_accepts_correct_pairs_and_rejects_look_alikes() -> None:
    """Twin rooms look alike except for some objects."""
    case = make_twin_room_problem(0)
    check, is_false = checker(case.problem, PairConsistencyCheck), np.array(case.false)[::3]
    shares = np.array([check.check_pair(pair).support_ratio for pair in case.problem.pairs[::3]])
    assert (shares[~is_false] > 0).mean() > 0.97
    assert (shares[is_false] == 0).mean() > 0.5


class FixedResults(PairConsistencyCheck):
    """Replacement of the pair check that returns given results by image pair."""

    results: Mapping[tuple[int, int], PairConsistency]

    def check_pair(self, pair: VerifiedPair) -> PairConsistency:
        return self.results[pair.image_a, pair.image_b]


def reweighted_problem(
    counts: Sequence[int], share: float, turn_deg: float
) -> tuple[MappingProblem, MappingProblem]:
    """Return a problem of three images and its reweighted version.

    Pairs 0-1 and 1-2 are consistent. Pair 0-2 has the given support ratio, and its rotation differs
    from that of the others by ``turn_deg``. ``counts``: matches of the pairs 0-1, 0-2 and 1-2.
    """
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    pairs = [
        replace(pair, matches=pair.matches[:count], scores=pair.scores[:count])
        for pair, count in zip(problem.pairs, counts, strict=True)
    ]
    problem = replace(problem, pairs=tuple(pairs))
    assert [len(pair) for pair in pairs] == list(counts)
    check = checker(problem, FixedResults)
    turn: Float64 = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    check.results = {
        (0, 1): PairConsistency(pairs[0].rotation, 1.0),
        (0, 2): PairConsistency(turn @ pairs[2].rotation @ pairs[0].rotation, share),
        (1, 2): PairConsistency(pairs[2].rotation, 1.0),
    }
    weights = check.compute_pair_weights(problem, np.ones(3, dtype=np.bool_))
    return problem, reweight_pairs(problem, weights)


def test_pair_that_depth_and_consistent_pairs_contradict_is_removed() -> None:
    problem, reweighted = reweighted_problem([60, 50, 60], share=0.0, turn_deg=90.0)
    assert reweighted.pairs == (problem.pairs[0], problem.pairs[2])


@pytest.mark.parametrize(
    ("counts", "turn_deg"),
    [([60, 50, 60], 10.0), ([60, 70, 60], 90.0), ([60, 40, 20], 90.0), ([60, 20, 60], 90.0)],
    ids=["same rotation", "fewer matches", "too few consistent matches", "too few own matches"],
)
def test_pair_that_only_depth_contradicts_stays(counts: list[int], turn_deg: float) -> None:
    problem, reweighted = reweighted_problem(counts, share=0.0, turn_deg=turn_deg)
    assert reweighted.pairs == problem.pairs


def test_match_scores_are_multiplied_by_support_ratio() -> None:
    problem, reweighted = reweighted_problem([60, 50, 60], share=0.5, turn_deg=90.0)
    assert [len(pair) for pair in reweighted.pairs] == [60, 50, 60]
    np.testing.assert_allclose(reweighted.pairs[1].scores, 0.5 * problem.pairs[1].scores)
    assert reweighted.pairs[0] is problem.pairs[0]


def test_only_pairs_of_candidate_images_are_checked() -> None:
    """Images of earlier components keep their poses, and may be the majority."""
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    check = checker(problem, FixedResults)
    check.results = {(1, 2): PairConsistency(np.eye(3), 0.5)}
    weights = check.compute_pair_weights(problem, np.array([False, True, True]))
    assert weights.tolist() == [1.0, 1.0, 0.5]


def test_globally_initialized_images_need_no_pair_check() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(4, 10.0))
    result = reconstruct(problem)
    assert len(result.reconstructions[0].images) == 4
    assert "pair consistency check" not in result.report.counts
    pair_alone = MapperOptions.model_validate(
        {"global_initialization": False, "consistency": {"check_pairs": False}}
    )
    result = reconstruct(problem, pair_alone)
    assert result.reconstructions and "pair consistency check" not in result.report.counts
