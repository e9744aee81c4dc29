"""Tests of metrics on errors with known coverage and order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.calibration.metrics import NORMAL_COVERAGE, compute_metrics, sensitivity_curve
from mpsfm_core.calibration.samples import Residuals
from mpsfm_core.data import Float64


def residuals_of(error: Float64, images: int = 1) -> Residuals:
    count = len(error)
    return Residuals(
        error=error,
        noise=np.zeros(count),
        terms=np.ones((count, 1)),
        names=("relative_std",),
        step=np.zeros(count),
        image=np.arange(count) % images,
        magnitude=np.abs(error),
        unit=np.ones(count),
        place=np.linspace(1, 5, count),
        images=images,
        limit=2.0,
        scales=np.zeros(images),
    )


def test_metrics_of_calibrated_std_are_ideal() -> None:
    rng = np.random.default_rng(0)
    std = np.exp(rng.normal(-2, 0.5, 100_000))
    metrics = compute_metrics(residuals_of(std * rng.normal(size=len(std))), std)
    assert metrics["coverage"] == pytest.approx(NORMAL_COVERAGE, abs=0.004)
    assert metrics["z_mad"] == pytest.approx(1, abs=0.01)
    entropy = (0.5 * np.log(2 * np.pi * np.e * std**2)).mean()
    assert metrics["nll"] == pytest.approx(entropy, abs=0.01)
    for one in metrics["calibration_curve"]:
        assert one["rmse"] == pytest.approx(one["std"], rel=0.04)
    assert all(b["coverage"][0] == pytest.approx(0.683, abs=0.015) for b in metrics["by_range"])


def test_metrics_of_underestimated_std_are_bad() -> None:
    rng = np.random.default_rng(0)
    error = rng.normal(size=20_000)
    right, wrong = (compute_metrics(residuals_of(error), np.full(20_000, s)) for s in (1.0, 0.2))
    assert wrong["coverage"][0] == pytest.approx(0.1585, abs=0.01)
    assert wrong["z_mad"] == pytest.approx(5, rel=0.03)
    assert wrong["nll"] > right["nll"]
    assert wrong["nll_heavy"] > right["nll_heavy"]


def test_metrics_include_noise_of_truth() -> None:
    rng = np.random.default_rng(0)
    error = 0.5 * rng.normal(size=50_000)
    noisy = replace(residuals_of(error), noise=np.full(50_000, 0.4))
    assert compute_metrics(noisy, np.full(50_000, 0.3))["z_mad"] == pytest.approx(1, abs=0.02)


def test_ause_is_zero_for_true_order() -> None:
    error = np.random.default_rng(0).normal(size=5_000)
    residuals = residuals_of(error)
    perfect = compute_metrics(residuals, np.abs(error) + 1e-9)["ause"]
    ignorant = compute_metrics(residuals, np.ones(5_000))["ause"]
    opposite = compute_metrics(residuals, 1 / (np.abs(error) + 1e-3))["ause"]
    assert perfect == pytest.approx(0, abs=1e-9)
    assert 0.2 < ignorant < opposite


def test_sensitivity_curve_matches_hand_computed_values() -> None:
    curve = sensitivity_curve(np.array([3.0, 0.0, 4.0, 0.0]), np.array([0.1, 0.2, 0.3, 0.4]))
    total = np.sqrt(25 / 4)
    assert curve["recall"] == [0.25, 0.5, 0.75, 1.0]
    expected = [3.0, np.sqrt(9 / 2), np.sqrt(25 / 3), total]
    assert curve["predicted"] == pytest.approx([value / total for value in expected])
    ideal = [0, 0, np.sqrt(9 / 3), total]
    assert curve["ideal"] == pytest.approx([value / total for value in ideal])


def test_sensitivity_curve_shuffles_equal_stds() -> None:
    error = np.concatenate([np.zeros(500), np.ones(500)])
    curve = sensitivity_curve(error, np.ones(1000))
    assert curve["predicted"][len(curve["predicted"]) // 2] == pytest.approx(1, abs=0.1)


def test_metrics_weight_images_equally() -> None:
    good, bad = np.full(900, 0.1), np.full(100, 10.0)
    residuals = replace(
        residuals_of(np.concatenate([good, bad]), images=2), image=np.repeat([0, 1], [900, 100])
    )
    assert compute_metrics(residuals, np.ones(1000))["coverage"][0] == pytest.approx(0.5)
