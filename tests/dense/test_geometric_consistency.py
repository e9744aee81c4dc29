"""What depths of several views say of each other."""

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
    """From our depth to another view's, both as noisy; NaN at a share that is ``wrong``."""
    rng = np.random.default_rng(seed)
    ours, theirs = std_px * rng.normal(size=(2, *SHAPE))
    found = ((theirs - ours) / parallax).astype(np.float32)
    found[rng.random(SHAPE) < wrong] = np.nan
    return found


@pytest.mark.parametrize("std_px", [0.1, 0.3, 1.0])
def test_differences_say_how_exact_matches_are(std_px: float) -> None:
    """Where a pixel moves far and where it moves little, and whatever nobody confirms."""
    rows = np.linspace(50, 400, SHAPE[0], dtype=np.float32)
    parallax = np.repeat(rows[:, None], SHAPE[1], axis=1)
    found = [differences(std_px, parallax, seed, wrong=0.4) for seed in range(3)]
    agreement = evaluate_consistency(parallax, found)
    assert agreement.match_std_px == pytest.approx(std_px, rel=0.03)
    assert agreement.confirmed.mean() == pytest.approx(1 - 0.4**3, abs=0.01)


def test_the_mean_is_that_of_ours_and_those_that_agree() -> None:
    parallax = np.ones(SHAPE, np.float32)
    one, other = np.full(SHAPE, 0.3, np.float32), np.full(SHAPE, np.nan, np.float32)
    np.testing.assert_allclose(evaluate_consistency(parallax, [one, other]).mean_change, 0.15)
    np.testing.assert_allclose(evaluate_consistency(parallax, [one, one]).mean_change, 0.2)


def test_nobody_says_nothing() -> None:
    agreement = evaluate_consistency(np.ones(SHAPE, np.float32), [])
    assert not agreement.confirmed.any()
    assert np.isnan(agreement.match_std_px)


@pytest.mark.parametrize("views", [0, 1, 4])
def test_errors_of_maps_hang_together(views: int) -> None:
    """Maps with a correlation of 0.3: of the mean of all 68 % are within its std."""
    rng, parallax, std_px = np.random.default_rng(0), np.full(SHAPE, 50, np.float32), 0.4
    common = 0.3**0.5 * rng.normal(size=SHAPE)
    errors = std_px * (common + 0.7**0.5 * rng.normal(size=(1 + max(views, 1), *SHAPE)))
    found = [((each - errors[0]) / 50).astype(np.float32) for each in errors[1:]]
    agreement = evaluate_consistency(parallax, found)
    if not views:  # where nobody agrees our own error is left
        agreement = replace(agreement, views=np.zeros(SHAPE, np.uint16))
    mean = errors[: 1 + views].mean(axis=0)
    assert (np.abs(mean) < agreement.std_px).mean() == pytest.approx(0.683, abs=0.01)


def test_errors_of_poses_are_in_every_map() -> None:
    parallax, found = np.ones(SHAPE, np.float32), [np.zeros(SHAPE, np.float32)] * 4
    np.testing.assert_allclose(evaluate_consistency(parallax, found, pose_std_px=0.7).std_px, 0.7)


def test_what_differs_by_more_than_agrees_is_beyond() -> None:
    grid = PosedGrid(PinholeCamera(4, 1, 10.0, 10.0, 2.0, 0.5), np.eye(3), np.zeros(3))
    std = np.full((1, 4), 0.01, np.float32)
    own = PosedDepth(grid, np.zeros((1, 4), np.float32), std)
    # three times the std of two maps, 0.042, agree
    other = own._replace(log_depth=np.array([[0.0, 0.04, -0.08, 0.09]], np.float32))
    found = compare_depths(own, other)
    assert found.agree.tolist() == [[True, True, False, False]]
    assert found.beyond.tolist() == [[False, False, True, False]]
    usable = found.where(np.array([[False, True, False, True]]))
    assert usable.agree.tolist() == [[False, True, False, False]] and not usable.beyond.any()


@pytest.mark.parametrize(
    ("beyond", "found", "chance"), [(0.9, 0.1, True), (0.9, 0.5, False), (0.1, 0.1, False)]
)
def test_what_agrees_by_chance_agrees_no_oftener_than_not(
    beyond: float, found: float, chance: bool
) -> None:
    rng = np.random.default_rng(0)
    agree = np.where(rng.random(SHAPE) < 0.2, 0, np.nan).astype(np.float32)
    off = ~np.isfinite(agree) & (rng.random(SHAPE) < 0.25 * beyond)
    assert DepthDifferences(agree, off).by_chance(found) == chance
