"""Dense matches become keypoints: snapped, kept apart, thinned by certainty."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import DenseMatches
from mpsfm_core.extraction.matching.dense_matches import sample_dense_matches, snap_to_keypoints

NOTHING = np.empty((0, 2))


def dense(points_a, scores, shift=(100.0, 0.0)) -> DenseMatches:
    points = np.array(points_a, dtype=np.float64).reshape(-1, 2)
    return DenseMatches(points, points + shift, np.array(scores, dtype=np.float32))


def test_the_most_certain_of_neighbours_stays() -> None:
    matches = dense([[10, 10], [13, 10], [40, 10], [47, 10], [100, 10]], [0.5, 0.9, 0.8, 0.3, 0.2])
    found = sample_dense_matches(matches, NOTHING, NOTHING)
    assert found.xy_a.tolist() == [[13, 10], [40, 10], [100, 10]]
    assert found.xy_b.tolist() == [[113, 10], [140, 10], [200, 10]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.8, 0.2])


def test_a_removed_one_removes_nobody() -> None:
    """10 removes 16; 22 is near 16 only and stays."""
    matches = dense([[10, 0], [16, 0], [22, 0]], [0.9, 0.8, 0.7])
    assert sample_dense_matches(matches, NOTHING, NOTHING).xy_a[:, 0].tolist() == [10, 22]


def test_neighbours_in_the_second_image_are_thinned_too() -> None:
    points_a = np.array([[10.0, 10], [60.0, 10]])
    points_b = np.array([[10.0, 10], [12.0, 10]])
    matches = DenseMatches(points_a, points_b, np.array([0.4, 0.6], dtype=np.float32))
    assert sample_dense_matches(matches, NOTHING, NOTHING).xy_a.tolist() == [[60, 10]]


def test_away_from_keypoints_of_both_images() -> None:
    matches = dense([[10, 10], [50, 10], [90, 10]], [0.9, 0.9, 0.9])
    keypoints_a, keypoints_b = np.array([[12.0, 13.0]]), np.array([[187.0, 10.0]])
    found = sample_dense_matches(matches, keypoints_a, keypoints_b)
    assert found.xy_a.tolist() == [[50, 10]]


def test_uncertain_ones_are_left_out() -> None:
    matches = dense([[10, 10], [50, 10]], [0.05, 0.1])
    assert len(sample_dense_matches(matches, NOTHING, NOTHING).scores) == 1


def test_large_random_set_against_brute_force() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 200, (400, 2))
    scores = rng.uniform(0.1, 1, 400).astype(np.float32)
    found = sample_dense_matches(dense(points, scores), NOTHING, NOTHING)
    kept: list[int] = []
    for row in np.argsort(-scores):
        if all(np.linalg.norm(points[row] - points[other]) >= 8 for other in kept):
            kept.append(int(row))
    assert found.xy_a.tolist() == points[kept].tolist()


def test_snapping() -> None:
    keypoints_a = np.array([[10.0, 10.0], [50.0, 10.0], [90.0, 10.0]])
    keypoints_b = np.array([[190.0, 10.0], [110.0, 10.0], [160.0, 10.0]])
    matches = dense([[11, 10], [9.5, 10], [50, 11], [89, 10], [200, 10]], [0.5, 0.8, 0.9, 0.7, 1])
    found = snap_to_keypoints(matches, keypoints_a, keypoints_b, 2.0)
    pairs = dict(zip(map(tuple, found.indices.tolist()), found.scores.tolist(), strict=True))
    # 50 has no keypoint near 150; of the two at 10 the more certain one counts.
    assert pairs == pytest.approx({(0, 1): 0.8, (2, 0): 0.7})


def test_snapping_uses_a_keypoint_once() -> None:
    """Two dense matches from different keypoints end at the same one: the more certain wins."""
    points_a = np.array([[10.0, 10], [20.0, 10]])
    points_b = np.array([[101.0, 10], [100.0, 10]])
    matches = DenseMatches(points_a, points_b, np.array([0.6, 0.7], dtype=np.float32))
    found = snap_to_keypoints(matches, points_a, np.array([[100.0, 10.0]]), 2.0)
    assert found.indices.tolist() == [[1, 0]]


@pytest.mark.parametrize("keypoints", [NOTHING, np.array([[500.0, 500.0]])])
def test_nothing_to_snap_to(keypoints) -> None:
    assert len(snap_to_keypoints(dense([[10, 10]], [0.9]), keypoints, keypoints, 2.0)) == 0
    assert len(snap_to_keypoints(dense([], []), keypoints, keypoints, 2.0)) == 0
    assert len(sample_dense_matches(dense([], []), keypoints, keypoints).scores) == 0
