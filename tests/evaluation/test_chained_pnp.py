"""Tests of the chained-PnP baseline on views with known poses and depth."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.evaluation import CONVENTIONS, pose_errors_deg
from mpsfm_core.evaluation.chained_pnp import estimate_chained_poses
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 515.0, 318.0, 242.0)
POSES = arc_poses(5, 10.0)
TRUTH = {f"view_{i}.png": (pose[:, :3], pose[:, 3]) for i, pose in enumerate(POSES)}


def problem(links: list[tuple[int, int]]) -> MappingProblem:
    return make_mapping_problem(room_scene(), CAMERA, POSES, links=links)


def test_chained_poses_follow_pairs_in_both_directions() -> None:
    (model,) = estimate_chained_poses(problem([(0, 2), (1, 2), (1, 4), (3, 4)]))
    assert set(model) == set(TRUTH)
    assert pose_errors_deg(model, TRUTH, CONVENTIONS["paper"]).max() < 0.5


def test_chained_poses_of_components_are_separate_models() -> None:
    models = estimate_chained_poses(problem([(0, 1), (2, 3), (3, 4), (2, 4)]))
    assert [sorted(model) for model in models] == [
        ["view_2.png", "view_3.png", "view_4.png"],
        ["view_0.png", "view_1.png"],
    ]
    assert len(estimate_chained_poses(problem([(0, 1)]))) == 1
    assert estimate_chained_poses(problem([])) == []


def test_models_convention_counts_all_models() -> None:
    largest, other = estimate_chained_poses(problem([(0, 1), (2, 3), (3, 4), (2, 4)]))
    record = BenchmarkRecord(
        "s", "c", "b", "b-00", "m", "", largest, TRUTH, 4, 0.0, 0.0, others=[other]
    )
    largest_only = (record.errors_deg(CONVENTIONS["paper"]) < 1).sum()
    assert largest_only == 6  # Three images have six ordered pairs.
    assert (record.errors_deg(CONVENTIONS["models"]) < 1).sum() == 8
    assert np.count_nonzero(record.errors_deg(CONVENTIONS["models"]) == 180) == 12
