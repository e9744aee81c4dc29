"""Metrics of a declared std: coverage, sensitivity and calibration curves."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student_t

from mpsfm_core.calibration.samples import Residuals
from mpsfm_core.calibration.std_likelihood import FREEDOM, ONE_SIGMA, STD_OF_T
from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry.statistics import MAD_TO_STD, weighted_quantile

CURVE_POINTS = 50
"""Number of points of a sensitivity curve."""
BINS = 10
"""Number of bins of a calibration curve."""
RANGES = 5
"""Number of ranges of depth or slant for which the report gives the coverage."""
NORMAL_COVERAGE = (ONE_SIGMA, 0.9545, 0.9973)
"""Probabilities that a normally distributed error is within 1, 2 and 3 stds."""


def compute_metrics(residuals: Residuals, std: Float64) -> dict[str, Any]:
    """Compute all metrics of a declared std (n,); images have equal weight except in curves.

    The key ``coverage`` is the ratio of errors within 1, 2 and 3 stds. The key ``z_mad`` is 1.4826
    times the median of ``|error / std|``, 1 for a correct std. The key ``nll`` is the mean negative
    log density of a normal distribution with the std. The key ``nll_heavy`` is the mean negative
    log density of the fitted Student t distribution, which has the same coverage of 1 std. The key
    ``ause`` is the area between the sensitivity curves for errors sorted by std and by true error,
    relative to the total RMSE. An ``ause`` of 0 is a perfect order. The key ``rmse`` is the RMSE in
    meters or rad. The remaining keys are the sensitivity curve, the calibration curve, and the
    coverage by range of depth or slant.
    """
    total, weights = np.hypot(std, residuals.noise), residuals.weights()
    heavy_scale = total / STD_OF_T

    def mean(values: Float64) -> float:
        return float(np.average(values, weights=weights))

    sensitivity = sensitivity_curve(residuals.magnitude, std * residuals.unit)
    return {
        **_summary(residuals.error, total, weights),
        "nll": -mean(norm.logpdf(residuals.error, scale=total)),
        "nll_heavy": -mean(student_t(FREEDOM, scale=heavy_scale).logpdf(residuals.error)),
        "rmse": np.sqrt(mean(residuals.magnitude**2)),
        "ause": float(np.mean(sensitivity["predicted"]) - np.mean(sensitivity["ideal"])),
        "sensitivity": sensitivity,
        "calibration_curve": _curve_by_std(residuals.error, total),
        "by_range": _by_range(residuals, total),
    }


def compute_coverage(error: Float64, std: Float64, weights: Float64) -> list[float]:
    """Compute the ratio of errors (n,) within 1, 2 and 3 stds (n,)."""
    z = np.abs(error) / std
    return [float(np.average(z <= limit, weights=weights)) for limit in (1, 2, 3)]


def sensitivity_curve(errors: Float64, std: Float64) -> dict[str, list[float]]:
    """Compute the sensitivity (sparsification) curve [paper, appendix C].

    Returns:
        Curve by key. The key ``recall`` is the ratio of samples in (0, 1]. The keys ``predicted``
        and ``ideal`` are the RMSE of the samples with the smallest std and with the smallest
        errors, relative to the RMSE of all samples.
    """
    count = len(errors)
    ends = np.unique(np.ceil(np.linspace(0, 1, CURVE_POINTS + 1)[1:] * count).astype(np.int64))
    squared = errors**2
    total = max(float(np.sqrt(squared.mean())), 1e-12)

    def curve(order: Int64) -> list[float]:
        means = np.cumsum(squared[order])[ends - 1] / ends
        return [float(value) for value in np.sqrt(means) / total]

    # Samples of equal std have a fixed random order, independent of the image.
    shuffled = np.random.default_rng(0).permutation(count)
    predicted = shuffled[np.argsort(std[shuffled], kind="stable")]
    return {
        "recall": [float(end / count) for end in ends],
        "predicted": curve(predicted),
        "ideal": curve(np.argsort(errors)),
    }


def _curve_by_std(error: Float64, total: Float64) -> list[dict[str, float]]:
    """Compute declared std and actual error std in bins of similar declared std."""
    return [
        {
            "std": float(np.sqrt((total[rows] ** 2).mean())),
            "rmse": float(np.sqrt((error[rows] ** 2).mean())),
            "robust_std": MAD_TO_STD * float(np.median(np.abs(error[rows]))),
            "samples": int(rows.sum()),
        }
        for rows in _quantile_bins(total, BINS)
    ]


def _by_range(residuals: Residuals, total: Float64) -> list[dict[str, Any]]:
    """Compute the coverage of the declared std in ranges of depth or slant."""
    weights = residuals.weights()
    return [
        {
            "from": float(residuals.place[rows].min()),
            "to": float(residuals.place[rows].max()),
            "samples": int(rows.sum()),
            "std": float(np.median(total[rows])),
            **_summary(residuals.error[rows], total[rows], weights[rows]),
        }
        for rows in _quantile_bins(residuals.place, RANGES)
    ]


def _summary(error: Float64, total: Float64, weights: Float64) -> dict[str, Any]:
    z_mad = MAD_TO_STD * weighted_quantile(np.abs(error) / total, weights, 0.5)
    return {"coverage": compute_coverage(error, total, weights), "z_mad": z_mad}


def _quantile_bins(values: Float64, count: int) -> list[Bool]:
    """Split values into bins of similar size and return a mask (n,) of each bin."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, count + 1)[1:-1]))
    number = np.searchsorted(edges, values, side="right")
    rows = [number == bin_ for bin_ in range(len(edges) + 1)]
    return [r for r in rows if r.any()]
