"""Tests of the geometric consistency check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float32, PinholeCamera
from mpsfm_core.dense.dense_view import PosedGrid
from mpsfm_core.dense.geometric_consistency import (
    DepthDifferences,
    PosedDepth,
    compare_depths,
    evaluate_consistency,
)

SHAPE = 200, 300


def differences(std_px: float, parallax: Float32, seed: int, wrong: float = 0.0) -> Float32:
    """Simulate differences of two equally noisy depth maps, NaN at a ratio `wrong` of pixels."""
    rng = np.random.default_rng(seed)
    ours, theirs = std_px * rng.normal(size=(2, *SHAPE))
    found = ((theirs - ours) / parallax).astype(np.float32)
    found[rng.random(SHAPE) < wrong] = np.nan
    return found


@pytest.mark.parametrize("std_px", [0.1, 0.3, 1.0])
def test_evaluate_consistency_estimates_match_std(std_px: float) -> None:
    rows = np.linspace(50, 400, SHAPE[0], dtype=np.float32)
    parallax = np.repeat(rows[:, None], SHAPE[1], axis=1)
    found = [differences(std_px, parallax, seed, wrong=0.4) for seed in range(3)]
    agreement = evaluate_consistency(SHAPE, [(each, parallax) for each in found])
    assert agreement.match_std_px == pytest.approx(std_px, rel=0.03)
    assert agreement.confirmed.mean() == pytest.approx(1 - 0.4**3, abs=0.01)


def test_evaluate_consistency_averages_consistent_depths() -> None:
    parallax = np.ones(SHAPE, np.float32)
    one, other = np.full(SHAPE, 0.3, np.float32), np.full(SHAPE, np.nan, np.float32)
    for second, change in ((other, 0.15), (one, 0.2)):
        agreement = evaluate_consistency(SHAPE, [(one, parallax), (second, parallax)])
        np.testing.assert_allclose(agreement.mean_change, change)


def test_evaluate_consistency_without_views_confirms_nothing() -> None:
    agreement = evaluate_consistency(SHAPE, [])
    assert not agreement.confirmed.any()
    assert np.isnan(agreement.match_std_px)


@pytest.mark.parametrize("views", [0, 1, 4])
def test_std_px_accounts_for_correlated_errors(views: int) -> None:
    """The mean of maps with error correlation 0.3 is within its std in 68 % of the pixels."""
    rng, parallax, std_px = np.random.default_rng(0), np.full(SHAPE, 50, np.float32), 0.4
    common = 0.3**0.5 * rng.normal(size=SHAPE)
    errors = std_px * (common + 0.7**0.5 * rng.normal(size=(1 + max(views, 1), *SHAPE)))
    found = [((each - errors[0]) / 50).astype(np.float32) for each in errors[1:]]
    agreement = evaluate_consistency(SHAPE, [(each, parallax) for each in found])
    if not views:  # Without consistent views, only the error of the map remains.
        agreement = replace(agreement, views=np.zeros(SHAPE, np.uint16))
    mean = errors[: 1 + views].mean(axis=0)
    assert (np.abs(mean) < agreement.std_px).mean() == pytest.approx(0.683, abs=0.01)


def test_std_px_includes_pose_error() -> None:
    parallax, found = np.ones(SHAPE, np.float32), [np.zeros(SHAPE, np.float32)] * 4
    differences = [(each, parallax) for each in found]
    np.testing.assert_allclose(evaluate_consistency(SHAPE, differences, 0.7).std_px, 0.7)


def test_log_std_depends_on_parallax_of_consistent_views() -> None:
    far = np.full(SHAPE, 100, np.float32)
    far_difference = np.where(np.arange(SHAPE[1]) < 100, np.float32(0), np.float32(np.nan))
    found = [
        (np.zeros(SHAPE, np.float32), np.full(SHAPE, 20, np.float32)),
        (np.broadcast_to(far_difference, SHAPE), far),
    ]
    log_std = evaluate_consistency(SHAPE, found, pose_std_px=1.0).log_std
    np.testing.assert_allclose(log_std[:, :100], 1 / 100, rtol=1e-6)
    np.testing.assert_allclose(log_std[:, 100:], 1 / 20, rtol=1e-6)


def test_compare_depths_separates_agreement_and_near_miss() -> None:
    grid = PosedGrid(PinholeCamera(4, 1, 10.0, 10.0, 2.0, 0.5), np.eye(3), np.zeros(3))
    std = np.full((1, 4), 0.01, np.float32)
    own = PosedDepth(grid, np.zeros((1, 4), np.float32), std)
    # Depths are consistent up to three times the std of a difference, 0.042.
    other = own._replace(log_depth=np.array([[0.0, 0.04, -0.08, 0.09]], np.float32))
    found = compare_depths(own, other)
    assert found.agree.tolist() == [[True, True, False, False]]
    assert found.near_miss.tolist() == [[False, False, True, False]]
    usable = found.where(np.array([[False, True, False, True]]))
    assert usable.agree.tolist() == [[False, True, False, False]] and not usable.near_miss.any()


@pytest.mark.parametrize(
    ("near_miss_ratio", "found", "chance"), [(0.9, 0.1, True), (0.9, 0.5, False), (0.1, 0.1, False)]
)
def test_is_coincidental_needs_near_misses_and_few_patches(
    near_miss_ratio: float, found: float, chance: bool
) -> None:
    rng = np.random.default_rng(0)
    agree = np.where(rng.random(SHAPE) < 0.2, 0, np.nan).astype(np.float32)
    off = ~np.isfinite(agree) & (rng.random(SHAPE) < 0.25 * near_miss_ratio)
    assert DepthDifferences(agree, off).is_coincidental(found) == chance
