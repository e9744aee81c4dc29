"""Pairs beside depth: look-alikes are refuted, right pairs are not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, Float64, MappingProblem, PinholeCamera, VerifiedPair
from mpsfm_core.mapping.consistency.pair_consistency import PairConsistency, PairConsistencyCheck
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
    refiner = Refiner(scene, options, compute_pair_scores(scene, "match-scores"))
    return kind(AbsolutePoseEstimator(scene, refiner, options), options)


def test_right_pairs_are_allowed_and_many_look_alikes_are_not() -> None:
    """Views of twin rooms, of which the pieces that differ tell."""
    case = make_twin_room_problem(0)
    check, false = checker(case.problem, PairConsistencyCheck), np.array(case.false)
    shares = np.array([check.check_pair(pair).support_ratio for pair in case.problem.pairs])
    assert (shares[~false] > 0).mean() > 0.97
    assert (shares[false] == 0).mean() > 0.5


class Judged(PairConsistencyCheck):
    """With verdicts that are given, by images."""

    verdicts: Mapping[tuple[int, int], PairConsistency]

    def check_pair(self, pair: VerifiedPair) -> PairConsistency:
        return self.verdicts[pair.image_a, pair.image_b]


def reweighted_problem(
    counts: Sequence[int], share: float, turn_deg: float
) -> tuple[MappingProblem, MappingProblem]:
    """Three images, and what is left of them: pairs 0-1 and 1-2, which depth allows, and 0-2 with
    a share and turned against them. ``counts``: matches of the pairs 0-1, 0-2 and 1-2."""
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    pairs = [
        replace(pair, matches=pair.matches[:count], scores=pair.scores[:count])
        for pair, count in zip(problem.pairs, counts, strict=True)
    ]
    problem = replace(problem, pairs=tuple(pairs))
    assert [len(pair) for pair in pairs] == list(counts)
    check = checker(problem, Judged)
    turn: Float64 = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    check.verdicts = {
        (0, 1): PairConsistency(pairs[0].rotation, 1.0),
        (0, 2): PairConsistency(turn @ pairs[2].rotation @ pairs[0].rotation, share),
        (1, 2): PairConsistency(pairs[2].rotation, 1.0),
    }
    return problem, check.reweight_pairs(problem, np.ones(3, dtype=np.bool_))


def test_what_depth_and_other_pairs_refute_does_not_count() -> None:
    problem, left = reweighted_problem([60, 50, 60], share=0.0, turn_deg=90.0)
    assert left.pairs == (problem.pairs[0], problem.pairs[2])


@pytest.mark.parametrize(
    ("counts", "turn_deg"),
    [([60, 50, 60], 10.0), ([60, 70, 60], 90.0), ([60, 40, 20], 90.0), ([60, 20, 60], 90.0)],
    ids=["others say the same", "tied by fewer", "tied by too few to register", "has too few"],
)
def test_a_pair_that_depth_alone_refutes_stays(counts: list[int], turn_deg: float) -> None:
    problem, left = reweighted_problem(counts, share=0.0, turn_deg=turn_deg)
    assert left.pairs == problem.pairs


def test_matches_count_as_far_as_an_allowed_pose_is_supported() -> None:
    problem, left = reweighted_problem([60, 50, 60], share=0.5, turn_deg=90.0)
    assert [len(pair) for pair in left.pairs] == [60, 50, 60]
    np.testing.assert_allclose(left.pairs[1].scores, 0.5 * problem.pairs[1].scores)
    assert left.pairs[0] is problem.pairs[0]


def test_only_pairs_of_images_that_are_left_are_asked() -> None:
    """What lies in groups before is settled, and may be most of what there is."""
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    check = checker(problem, Judged)
    check.verdicts = {(1, 2): PairConsistency(np.eye(3), 0.5)}
    left = check.reweight_pairs(problem, np.array([False, True, True]))
    assert left.pairs[:2] == problem.pairs[:2]
    np.testing.assert_allclose(left.pairs[2].scores, 0.5 * problem.pairs[2].scores)


def test_well_connected_images_need_no_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: PairConsistencyCheck, problem: MappingProblem, left: Bool) -> MappingProblem:
        raise AssertionError("not to be asked")

    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(4, 10.0))
    monkeypatch.setattr(PairConsistencyCheck, "reweight_pairs", refuse)
    (model,) = reconstruct(problem).reconstructions
    assert len(model.images) == 4
    pair_alone = MapperOptions.model_validate(
        {"initialization": {"global_initialization": False}, "consistency": {"check_pairs": False}}
    )
    assert reconstruct(problem, pair_alone).reconstructions
