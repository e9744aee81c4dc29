"""Fit of a calibration with bootstrap intervals and cross-validation over images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, TypeAlias

import numpy as np
from pydantic import Field

from mpsfm_core.calibration.metrics import compute_coverage, compute_metrics
from mpsfm_core.calibration.model_selection import (
    Candidate,
    DepthData,
    NormalData,
    select_candidate,
    std_of,
)
from mpsfm_core.calibration.samples import Residuals, concatenate_residuals
from mpsfm_core.calibration.std_likelihood import DOMINANT_SHARE, StdFit, bootstrap_fit
from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.options import Options
from mpsfm_core.geometry.statistics import MAD_TO_STD
from mpsfm_core.providers.uncertainty.calibration import Calibration

FEW_IMAGES = 10
"""Number of images below which the report warns that the fit is uncertain [ours]."""
WIDE_INTERVAL = 0.25
"""Relative half width of a std factor's confidence interval above which the report warns [ours]."""
MANY_GROSS = 0.2
"""Ratio of gross errors above which the report warns that the ground truth may be wrong [ours]."""
_INTERVAL = (2.5, 97.5)

CalibrationData: TypeAlias = DepthData | NormalData


class StudyOptions(Options):
    """Options of pixel sampling, cross-validation and bootstrap of a calibration study."""

    seed: int = Field(0, ge=0)
    """Seed of the pixel sampling and of the bootstrap."""
    folds: int = Field(4, ge=2)
    """Number of folds of the cross-validation.

    A fold is a group of successive images, because neighboring video frames are nearly equal. If
    the images are in several folders, a fold is a group of folders. The final calibration is fitted
    to all images."""
    bootstraps: int = Field(100, ge=0)
    """Number of bootstrap samples for confidence intervals; 0 disables the intervals."""


@dataclass(frozen=True, eq=False)
class CalibrationStudy:
    """Calibration, report and warnings of a calibration study."""

    calibration: Calibration
    """Calibration that is fitted to the samples of all images."""
    report: dict[str, Any]
    """All values of the calibration report as plain data."""
    warnings: tuple[str, ...]
    """Warnings that give reasons to doubt the calibration."""


def run_study(
    data: CalibrationData, declared: Calibration, options: StudyOptions
) -> CalibrationStudy:
    """Fit a calibration and compare it with the declared calibration by cross-validation.

    Args:
        data: Samples of prior and truth from at least one image.
        declared: Calibration that the provider's plugin declares.
        options: Options of pixel sampling, cross-validation and bootstrap.
    """
    candidates = data.fit()
    best = select_candidate(candidates)
    residuals = data.residuals(best.calibration)
    rng = np.random.default_rng(options.seed)
    intervals = _intervals(residuals, best.fit, options.bootstraps, rng)
    folds = _folds([image.name for image in data.samples], options.folds)
    fitted = [select_candidate(data.of(kept).fit()).calibration for kept, _ in folds]
    held_out = [data.of(left) for _, left in folds] or [data]
    report = {
        "images": [image.name for image in data.samples],
        "samples": len(residuals),
        "folds": len(folds),
        "calibration": {
            "before": declared.model_dump(mode="json"),
            "after": best.calibration.model_dump(mode="json"),
        },
        "intervals_95": intervals,
        "largest_term": dict(zip(best.fit.names, map(float, best.fit.shares), strict=True)),
        "gross_errors": best.fit.gross,
        "candidates": [_describe(candidate) for candidate in candidates],
        "metrics": {
            "before": evaluate_calibrations(held_out, [declared] * len(held_out)),
            "after": evaluate_calibrations(held_out, fitted or [best.calibration]),
        },
        "scale": _scale(data, best.calibration),
        "place": _place(data),
    }
    warnings = tuple(_warnings(len(data.samples), intervals, best.fit))
    return CalibrationStudy(best.calibration, {**report, "warnings": list(warnings)}, warnings)


def _folds(names: Sequence[str], wanted: int) -> list[tuple[Int64, Int64]]:
    """Return the indices of training and test images of each fold; no folds for a single image."""
    if len(names) < 2:
        return []
    folders, scene = np.unique([str(PurePosixPath(n).parent) for n in names], return_inverse=True)
    unit = scene if len(folders) > 1 else np.arange(len(names))
    count = int(unit.max()) + 1
    groups = np.array_split(np.arange(count), min(wanted, count))
    held_out = [np.isin(unit, group) for group in groups]
    return [(np.flatnonzero(~left), np.flatnonzero(left)) for left in held_out]


def evaluate_calibrations(
    held_out: Sequence[CalibrationData], calibrations: Sequence[Calibration]
) -> dict[str, Any]:
    """Compute the metrics of each fold's calibration on the test images of the fold.

    The metrics pool the errors of all images, after scaling each prior depth map to true depth. The
    coverage (ratio of errors within 1, 2 and 3 stds) is also reported per fold, and without scaling
    for metric priors.
    """
    scaled, std = _apply(held_out, calibrations, scaled=True)
    metrics = compute_metrics(concatenate_residuals(scaled), np.concatenate(std))
    metrics["coverage_of_folds"] = [_coverage(r, s)[0] for r, s in zip(scaled, std, strict=True)]
    first = held_out[0]
    if isinstance(first, DepthData) and first.samples[0].metric and first.in_meters:
        raw, std = _apply(held_out, calibrations, scaled=False)
        metrics["coverage_without_scaling"] = _coverage(
            concatenate_residuals(raw), np.concatenate(std)
        )
    return metrics


def _apply(
    held_out: Sequence[CalibrationData], calibrations: Sequence[Calibration], *, scaled: bool
) -> tuple[list[Residuals], list[Float64]]:
    """Compute errors and declared std of the test images of each fold."""
    parts = [d.residuals(c, scaled=scaled) for d, c in zip(held_out, calibrations, strict=True)]
    return parts, [std_of(c, r) for c, r in zip(calibrations, parts, strict=True)]


def _coverage(residuals: Residuals, std: Float64) -> list[float]:
    return compute_coverage(residuals.error, np.hypot(std, residuals.noise), residuals.weights())


def _place(data: CalibrationData) -> str:
    """Return the label (depth or slant) of the quantity by which errors are grouped."""
    if isinstance(data, NormalData):
        return "slant (degrees)"
    return "depth (m)" if data.in_meters else "depth (unit of the model)"


def _scale(data: CalibrationData, calibration: Calibration) -> dict[str, float] | None:
    """Compute the median over images of true / prior depth, and the std of its logarithm."""
    if isinstance(data, NormalData):
        return None
    scales = data.residuals(calibration).scales
    median = float(np.median(scales))
    spread = MAD_TO_STD * float(np.median(np.abs(scales - median)))
    return {"median": float(np.exp(median)), "log_spread": spread}


def _intervals(
    residuals: Residuals, fit: StdFit, count: int, rng: np.random.Generator
) -> dict[str, list[float]]:
    """Compute 95 % intervals of the std factors that the data determine; angles in degrees."""
    if count == 0 or residuals.images < 2:
        return {}
    low, high = np.percentile(bootstrap_fit(residuals, fit, count, rng), _INTERVAL, axis=0)
    intervals = {
        name: [float(low[j]), float(high[j])]
        for j, name in enumerate(fit.names)
        if fit.shares[j] >= DOMINANT_SHARE
    }
    if fit.edge_ratio is not None:
        intervals["edge_std_scale"] = [float(low[-1]), float(high[-1])]
    if "std_floor_deg" in intervals:
        degrees = [float(np.degrees(bound)) for bound in intervals.pop("std_floor_deg")]
        intervals["std_floor_deg" if "std_scale" in fit.names else "std_default_deg"] = degrees
    return intervals


def _describe(candidate: Candidate) -> dict[str, Any]:
    return {
        "name": candidate.name,
        "calibration": candidate.calibration.model_dump(mode="json"),
        "log_density": float(candidate.fit.log_density.mean()),
        "gain": candidate.gain,
        "standard_error": candidate.standard_error,
        "chosen": candidate.chosen,
    }


def _warnings(images: int, intervals: dict[str, list[float]], fit: StdFit) -> Iterator[str]:
    if images < FEW_IMAGES:
        yield f"fitted to only {images} images: add more images"
    if images < 2:
        yield "no cross-validation: the metrics are those of the only image; add more images"
    for name, (low, high) in intervals.items():
        if high - low > WIDE_INTERVAL * (high + low):
            yield f"{name} is between {low:.3g} and {high:.3g}: add more images"
    if fit.gross > MANY_GROSS:
        yield f"{fit.gross:.0%} of the errors are gross: check the truth of these images"
