"""Tests of the synthetic streets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.testing.synthetic.halls import HallProblem
from mpsfm_core.testing.synthetic.streets import make_street_problem

VIEWS = 56
NUM_STREETS = 4


@pytest.fixture(scope="module")
def streets() -> HallProblem:
    return make_street_problem(VIEWS, map_width=40)


def test_streets_are_connected_at_crossings(streets: HallProblem) -> None:
    a, b = np.array([(pair.image_a, pair.image_b) for pair in streets.problem.pairs]).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(VIEWS, VIEWS))
    assert connected_components(graph, directed=False)[0] == 1
    street_a, street_b = (NUM_STREETS * index // VIEWS for index in (a, b))
    crossing = {(s, t) for s, t in zip(street_a, street_b, strict=True) if s != t}
    assert crossing == {(0, 2), (0, 3), (1, 2), (1, 3)}  # the first two streets lead to the east


def test_matches_of_streets_are_true_except_for_the_wrong_ratio(streets: HallProblem) -> None:
    same = [
        streets.points[pair.image_a][pair.matches[:, 0]]
        == streets.points[pair.image_b][pair.matches[:, 1]]
        for pair in streets.problem.pairs
    ]
    assert 0.93 < np.concatenate(same).mean() < 0.97


def test_sky_has_no_depth_and_streets_have(streets: HallProblem) -> None:
    valid = [image.depth.valid for image in streets.problem.images]
    assert 0.05 < 1 - np.mean(valid) < 0.4
    assert np.mean([rows[-1] for rows in valid]) == 1
