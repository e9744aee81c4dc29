"""Tests of the doubts about providers that are wrong for every image of a run."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.data.mapping_problem import MappingImage
from mpsfm_core.extraction.output_checks import find_meaningless_scores, find_partial_coverage
from mpsfm_core.report.reasons import explain

CAMERA = PinholeCamera(2000, 1500, 1600.0, 1600.0, 1000.0, 750.0)


def images_with_keypoints(
    low: tuple[float, float], high: tuple[float, float], count: int = 4
) -> list[MappingImage]:
    """Return images whose keypoints lie between two corners, as ratios of the image size."""
    rng = np.random.default_rng(0)
    depth = DepthPrior.from_arrays(np.ones((2, 2)), np.full((2, 2), 0.01))
    facing = np.broadcast_to((0.0, 0.0, -1.0), (2, 2, 3))
    normals = NormalPrior.from_arrays(facing, np.full((2, 2), 0.01))
    return [
        MappingImage(
            f"{i}.jpg", CAMERA, rng.uniform(low, high, (200, 2)) * CAMERA.size, depth, normals
        )
        for i in range(count)
    ]


def test_find_partial_coverage_of_reduced_image_names_provider() -> None:
    doubt = find_partial_coverage(images_with_keypoints((0, 0), (0.32, 0.32)), "my-features")
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
    assert find_partial_coverage(images_with_keypoints(low, high, count), "sift") is None


def scored_pairs(shift: float, count: int = 4) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return scores of 80 inliers and 40 outliers, where inliers have scores higher by a shift."""
    rng = np.random.default_rng(0)
    inlier = np.arange(120) < 80
    return [
        (rng.uniform(0.2, 0.8, 120).astype(np.float32) + np.float32(shift) * inlier, inlier)
        for _ in range(count)
    ]


def test_find_meaningless_scores_of_inverted_scores_names_matcher() -> None:
    doubt = find_meaningless_scores(scored_pairs(-0.2), "my-matcher")
    assert doubt is not None
    explained = explain(doubt)
    assert "scores of the matcher my-matcher are not higher for inliers" in explained.text
    assert "in 4 pairs" in explained.text
    assert "mpsfm plugins check my-matcher" in explained.remedy


def test_find_meaningless_scores_pools_the_few_outliers_of_good_pairs() -> None:
    pairs = [(scores[:92], inlier[:92]) for scores, inlier in scored_pairs(-0.2, count=6)]
    assert find_meaningless_scores(pairs, "my-matcher") is not None


@pytest.mark.parametrize(
    "pairs",
    [
        scored_pairs(0.1),
        scored_pairs(-0.2, count=1),
        [(np.ones_like(scores), inlier) for scores, inlier in scored_pairs(0.0)],
        [(scores[:90], inlier[:90]) for scores, inlier in scored_pairs(-0.2)],
    ],
    ids=["good", "one pair", "constant", "few outliers"],
)
def test_find_meaningless_scores_of_usual_scores_is_silent(pairs: list) -> None:
    assert find_meaningless_scores(pairs, "nearest") is None
