"""Tests of the doubts about providers that are wrong for every image of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DenseMatches, PinholeCamera
from mpsfm_core.extraction.output_checks import (
    ScoredMatches,
    find_meaningless_scores,
    find_partial_coverage,
)
from mpsfm_core.report.reasons import explain

CAMERA = PinholeCamera(2000, 1500, 1600.0, 1600.0, 1000.0, 750.0)


def keypoints_of_images(
    low: tuple[float, float], high: tuple[float, float], count: int = 4
) -> list[np.ndarray]:
    """Return keypoints of images between two corners, which are ratios of the image size."""
    rng = np.random.default_rng(0)
    return [rng.uniform(low, high, (200, 2)) * CAMERA.size for _ in range(count)]


def test_find_partial_coverage_of_reduced_image_names_provider() -> None:
    doubt = find_partial_coverage(
        keypoints_of_images((0, 0), (0.32, 0.32)), [CAMERA] * 4, "my-features"
    )
    assert doubt is not None
    explained = explain(doubt)
    assert "my-features finds keypoints only in the upper left 32% x 32% of all 4" in explained.text
    assert "mpsfm plugins check my-features" in explained.remedy


@pytest.mark.parametrize(
    ("low", "high", "count"),
    [
        ((0.0, 0.0), (1.0, 1.0), 4),
        ((0.0, 0.4), (1.0, 1.0), 4),  # sky
        ((0.3, 0.2), (0.7, 0.75), 4),  # an object in the center
        ((0.0, 0.0), (0.3, 0.3), 2),
    ],
)
def test_find_partial_coverage_of_usual_images_is_silent(
    low: tuple[float, float], high: tuple[float, float], count: int
) -> None:
    keypoints = keypoints_of_images(low, high, count)
    assert find_partial_coverage(keypoints, [CAMERA] * count, "sift") is None


def scored_pairs(
    *, advantage: float = 0.0, smooth: float = 0.0, count: int = 10, ratio: float = 1 / 3
) -> list[ScoredMatches]:
    """Return pairs with 120 random scores each.

    Args:
        advantage: Excess of the scores of inliers over those of outliers.
        smooth: Range of a part of the scores that depends on the position in the image.
        count: Number of pairs.
        ratio: Ratio of outliers.
    """
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(count):
        xy = rng.uniform(size=(120, 2)) * CAMERA.size
        inlier = np.arange(120) >= ratio * 120
        scores = rng.uniform(0.3, 0.5, 120) + advantage * inlier
        scores += smooth * np.sin(xy[:, 0] / 200)
        pairs.append(ScoredMatches(xy, scores.astype(np.float32), inlier))
    return pairs


@pytest.mark.parametrize(
    "pairs",
    [
        scored_pairs(),
        scored_pairs(ratio=0),
        scored_pairs(count=40, ratio=0.02),
        scored_pairs(advantage=-0.2),
        scored_pairs(advantage=-0.2, smooth=0.1),
        scored_pairs(advantage=-0.2, count=1),
    ],
    ids=["random", "without outliers", "few outliers", "inverted", "inverted smooth", "one pair"],
)
def test_find_meaningless_scores_of_wrong_scores_names_matcher(pairs: list[ScoredMatches]) -> None:
    doubt = find_meaningless_scores(pairs, "my-matcher")
    assert doubt is not None
    explained = explain(doubt)
    assert "The scores of the matcher my-matcher are unrelated" in explained.text
    assert f"in {len(pairs)} pairs" in explained.text
    assert "mpsfm plugins check my-matcher" in explained.remedy


@pytest.mark.parametrize(
    "pairs",
    [
        scored_pairs(advantage=0.1),
        scored_pairs(smooth=0.1),
        scored_pairs(smooth=0.1, ratio=0),
        scored_pairs(count=2),
        [],
        [replace(pair, scores=np.ones_like(pair.scores)) for pair in scored_pairs()],
    ],
    ids=["good", "smooth", "without outliers", "few matches", "no pairs", "constant"],
)
def test_find_meaningless_scores_of_usual_scores_is_silent(pairs: list[ScoredMatches]) -> None:
    assert find_meaningless_scores(pairs, "nearest") is None


@pytest.mark.parametrize("seed", range(20))
def test_find_meaningless_scores_of_permuted_scores_names_matcher(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = [
        replace(pair, scores=rng.permutation(pair.scores))
        for pair in scored_pairs(advantage=0.1, smooth=0.1)
    ]
    assert find_meaningless_scores(pairs, "my-matcher") is not None


def test_find_meaningless_scores_compares_matches_at_equal_positions() -> None:
    pairs = [replace(pair, xy=np.zeros_like(pair.xy)) for pair in scored_pairs()]
    assert find_meaningless_scores(pairs, "my-matcher") is not None


def test_find_meaningless_scores_of_selected_dense_matches_names_matcher() -> None:
    """Selecting the best of several random scores gives neighboring scores a correlation."""
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(10):
        centers = rng.uniform(size=(120, 2)) * CAMERA.size
        # In the left half of the image, each selected match is the best of 20 instead of one.
        counts = np.where(centers[:, 0] < CAMERA.width / 2, 20, 1)
        xy = np.repeat(centers, counts, axis=0) + rng.normal(size=(counts.sum(), 2))
        scores = rng.random(len(xy), np.float32)
        best = np.maximum.reduceat(scores, np.cumsum(counts) - counts)
        dense = DenseMatches(xy, xy, scores)
        pairs.append(ScoredMatches(centers, best, np.ones(120, bool), dense))
    assert find_meaningless_scores(pairs, "my-matcher") is not None
    assert find_meaningless_scores([replace(p, dense=None) for p in pairs], "my-matcher") is None
