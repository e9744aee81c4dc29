"""Tests of the conversion of dense matches to keypoint matches."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import DenseMatches
from mpsfm_core.extraction.matching.dense_matches import sample_dense_matches, snap_to_keypoints

NOTHING = np.empty((0, 2))


def dense(points_a, scores, shift=(100.0, 0.0)) -> DenseMatches:
    points = np.array(points_a, dtype=np.float64).reshape(-1, 2)
    return DenseMatches(points, points + shift, np.array(scores, dtype=np.float32))


def test_sample_of_near_matches_selects_best_score() -> None:
    matches = dense([[10, 10], [13, 10], [40, 10], [47, 10], [100, 10]], [0.5, 0.9, 0.8, 0.3, 0.2])
    found = sample_dense_matches(matches, NOTHING, NOTHING)
    assert found.xy_a.tolist() == [[13, 10], [40, 10], [100, 10]]
    assert found.xy_b.tolist() == [[113, 10], [140, 10], [200, 10]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.8, 0.2])


def test_suppressed_match_does_not_suppress_other_matches() -> None:
    """The match at 10 suppresses 16, and 22 is near the suppressed 16 only."""
    matches = dense([[10, 0], [16, 0], [22, 0]], [0.9, 0.8, 0.7])
    assert sample_dense_matches(matches, NOTHING, NOTHING).xy_a[:, 0].tolist() == [10, 22]


def test_suppression_applies_to_second_image() -> None:
    points_a = np.array([[10.0, 10], [60.0, 10]])
    points_b = np.array([[10.0, 10], [12.0, 10]])
    matches = DenseMatches(points_a, points_b, np.array([0.4, 0.6], dtype=np.float32))
    assert sample_dense_matches(matches, NOTHING, NOTHING).xy_a.tolist() == [[60, 10]]


def test_sample_excludes_matches_near_keypoints_of_either_image() -> None:
    matches = dense([[10, 10], [50, 10], [90, 10]], [0.9, 0.9, 0.9])
    keypoints_a, keypoints_b = np.array([[12.0, 13.0]]), np.array([[187.0, 10.0]])
    found = sample_dense_matches(matches, keypoints_a, keypoints_b)
    assert found.xy_a.tolist() == [[50, 10]]


def test_sample_excludes_matches_of_low_score() -> None:
    matches = dense([[10, 10], [50, 10]], [0.05, 0.1])
    assert len(sample_dense_matches(matches, NOTHING, NOTHING).scores) == 1


def test_sample_of_random_matches_equals_brute_force() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 200, (400, 2))
    scores = rng.uniform(0.1, 1, 400).astype(np.float32)
    found = sample_dense_matches(dense(points, scores), NOTHING, NOTHING)
    kept: list[int] = []
    for row in np.argsort(-scores):
        if all(np.linalg.norm(points[row] - points[other]) >= 8 for other in kept):
            kept.append(int(row))
    assert found.xy_a.tolist() == points[kept].tolist()


def test_snap_assigns_matches_to_nearest_keypoints() -> None:
    keypoints_a = np.array([[10.0, 10.0], [50.0, 10.0], [90.0, 10.0]])
    keypoints_b = np.array([[190.0, 10.0], [110.0, 10.0], [160.0, 10.0]])
    matches = dense([[11, 10], [9.5, 10], [50, 11], [89, 10], [200, 10]], [0.5, 0.8, 0.9, 0.7, 1])
    found = snap_to_keypoints(matches, keypoints_a, keypoints_b, 2.0)
    pairs = dict(zip(map(tuple, found.indices.tolist()), found.scores.tolist(), strict=True))
    # The match 50 -> 150 has no keypoint near 150. Of two matches at 10, the higher score is used.
    assert pairs == pytest.approx({(0, 1): 0.8, (2, 0): 0.7})


def test_snap_of_two_matches_to_one_keypoint_selects_best_score() -> None:
    """If two dense matches snap to one keypoint, the match of higher score is used."""
    points_a = np.array([[10.0, 10], [20.0, 10]])
    points_b = np.array([[101.0, 10], [100.0, 10]])
    matches = DenseMatches(points_a, points_b, np.array([0.6, 0.7], dtype=np.float32))
    found = snap_to_keypoints(matches, points_a, np.array([[100.0, 10.0]]), 2.0)
    assert found.indices.tolist() == [[1, 0]]


@pytest.mark.parametrize("keypoints", [NOTHING, np.array([[500.0, 500.0]])])
def test_snap_without_keypoints_returns_no_matches(keypoints) -> None:
    assert len(snap_to_keypoints(dense([[10, 10]], [0.9]), keypoints, keypoints, 2.0)) == 0
    assert len(snap_to_keypoints(dense([], []), keypoints, keypoints, 2.0)) == 0
    assert len(sample_dense_matches(dense([], []), keypoints, keypoints).scores) == 0
