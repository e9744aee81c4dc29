"""What depths of several views say of each other."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import Float32
from mpsfm_core.dense.consistency import agreement_of

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
    agreement = agreement_of(parallax, found)
    assert agreement.match_std_px == pytest.approx(std_px, rel=0.03)
    assert agreement.confirmed.mean() == pytest.approx(1 - 0.4**3, abs=0.01)


def test_the_mean_is_that_of_ours_and_those_that_agree() -> None:
    parallax = np.ones(SHAPE, np.float32)
    one, other = np.full(SHAPE, 0.3, np.float32), np.full(SHAPE, np.nan, np.float32)
    np.testing.assert_allclose(agreement_of(parallax, [one, other]).mean_change, 0.15)
    np.testing.assert_allclose(agreement_of(parallax, [one, one]).mean_change, 0.2)


def test_nobody_says_nothing() -> None:
    agreement = agreement_of(np.ones(SHAPE, np.float32), [])
    assert not agreement.confirmed.any()
    assert np.isnan(agreement.match_std_px)
