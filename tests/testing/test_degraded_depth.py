"""Tests that simulated depth errors have the declared std and correlation length, and are
repeatable."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors, degrade_depth

FLAT = np.full((90, 120), 2.0, dtype=np.float32)


def log_errors(errors: DepthErrors, count: int = 200) -> np.ndarray:
    maps = [degrade_depth(FLAT, f"image {i}", errors) for i in range(count)]
    return np.log(np.stack(maps) / FLAT)


def test_same_image_has_the_same_errors() -> None:
    first = degrade_depth(FLAT, "a.png")
    np.testing.assert_array_equal(first, degrade_depth(FLAT, "a.png"))
    assert not np.allclose(first, degrade_depth(FLAT, "b.png"))
    assert not np.allclose(first, degrade_depth(FLAT, "a.png", seed=1))


def test_errors_have_the_stated_size() -> None:
    found = log_errors(DepthErrors(scale=0.04, field=0.03))
    assert found.std() == pytest.approx(0.05, rel=0.08)
    only_scale = log_errors(DepthErrors(scale=0.04, field=0.0))
    assert np.ptp(only_scale, axis=(1, 2)).max() < 1e-6
    assert only_scale.std() == pytest.approx(0.04, rel=0.12)


def test_declared_std_is_the_error_after_best_scale_per_image() -> None:
    """Check that the declared std excludes the scale, which the mapper estimates per image."""
    for scale in (0.0, 0.05, 0.5):
        errors = DepthErrors(scale=scale, field=0.05)
        assert errors.std == 0.05
        found = log_errors(errors)
        after = found - np.median(found, axis=(1, 2), keepdims=True)
        assert 0.9 * errors.std < after.std() < errors.std


def test_errors_are_correlated_over_the_stated_lengths() -> None:
    field = log_errors(DepthErrors(scale=0.0))
    width = FLAT.shape[1]
    for shift in (width // 30, width // 8):
        together = (field[..., shift:] * field[..., :-shift]).mean() / (field**2).mean()
        # White noise that is blurred with std s has the autocorrelation exp(-d^2 / (4 s^2)).
        shares = zip((0.64, 0.36), (width / 8, width / 30), strict=True)
        expected = sum(w * np.exp(-(shift**2) / (4 * s**2)) for w, s in shares)
        assert together == pytest.approx(expected, abs=0.08)


def test_unknown_depth_stays_unknown() -> None:
    depth = FLAT.copy()
    depth[:10] = 0
    degraded = degrade_depth(depth, "a")
    assert (degraded[:10] == 0).all() and (degraded[10:] > 0).all()
    assert degraded.dtype == np.float32
