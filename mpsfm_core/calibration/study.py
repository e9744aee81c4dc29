"""From samples to a calibration with its evidence: split, fit, intervals, before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from pydantic import Field

from mpsfm_core.calibration.fit import DOMINANT_SHARE, Fit, bootstrap
from mpsfm_core.calibration.fitting import Candidate, DepthData, NormalData, std_of, winner
from mpsfm_core.calibration.metrics import MAD_TO_STD, coverage, measure
from mpsfm_core.calibration.model import Calibration
from mpsfm_core.calibration.samples import Residuals
from mpsfm_core.data import Int64
from mpsfm_core.options import Options

FEW_IMAGES = 10
"""Fewer training images than these do not show how images differ (ours)."""
WIDE_INTERVAL = 0.25
"""Half width of an interval, as a share of the value, that calls for more data (ours)."""
MANY_GROSS = 0.2
"""Share of gross errors above which the truth itself is in doubt (ours)."""
_INTERVAL = (2.5, 97.5)

Data: TypeAlias = DepthData | NormalData


class StudyOptions(Options):
    """How a calibration is fitted."""

    seed: int = Field(0, ge=0)
    """Of the choice of pixels, held-out images and bootstrap."""
    held_out: float = Field(0.25, ge=0, lt=1)
    """Share of the images that metrics are taken on and nothing is fitted to."""
    bootstraps: int = Field(100, ge=0)
    """Fits on images drawn with replacement, for confidence intervals; 0 for none."""
    samples_per_image: int = Field(2000, ge=20)
    """Pixels of dense truth that are used of each image; its errors are far from independent."""


@dataclass(frozen=True, eq=False)
class Study:
    """A calibration and how it was found.

    ``report``: everything the report shows, plain data. ``warnings``: what makes it doubtful.
    """

    calibration: Calibration
    report: dict[str, Any]
    warnings: tuple[str, ...]


def study(data: Data, declared: Calibration, options: StudyOptions) -> Study:
    """Fit a calibration and compare it with the declared one on images it has not seen.

    ``data``: one image at least.
    """
    rng = np.random.default_rng(options.seed)
    fitted_on, held_out = _split(len(data.samples), options.held_out, rng)
    training = data.of(fitted_on)
    candidates = training.fit()
    best = winner(candidates)
    residuals = training.residuals(best.calibration)
    intervals = _intervals(residuals, best.fit, options.bootstraps, rng)
    judged = data.of(held_out) if len(held_out) else training
    report = {
        "images": {"fitted_on": _names(training), "held_out": _names(data.of(held_out))},
        "samples": len(residuals),
        "calibration": {
            "before": declared.model_dump(mode="json"),
            "after": best.calibration.model_dump(mode="json"),
        },
        "intervals_95": intervals,
        "largest_term": dict(zip(best.fit.names, map(float, best.fit.shares), strict=True)),
        "gross_errors": best.fit.gross,
        "candidates": [_describe(candidate) for candidate in candidates],
        "metrics": {
            "before": _metrics(judged, declared),
            "after": _metrics(judged, best.calibration),
        },
        "scale": _scale(data, best.calibration),
    }
    warnings = tuple(_warnings(training, held_out, intervals, best.fit))
    return Study(best.calibration, {**report, "warnings": list(warnings)}, warnings)


def _split(count: int, share: float, rng: np.random.Generator) -> tuple[Int64, Int64]:
    """Images to fit on and images held out: none of fewer than four, else at least one."""
    held_out = 0 if count < 4 or share == 0 else max(1, round(share * count))
    order = rng.permutation(count)
    return np.sort(order[held_out:]), np.sort(order[:held_out])


def _metrics(data: Data, calibration: Calibration) -> dict[str, Any]:
    """Metrics after each image's own scale, and coverage of a metric prior as it is."""
    residuals = data.residuals(calibration)
    metrics = measure(residuals, std_of(calibration, residuals))
    if isinstance(data, NormalData) or not data.samples[0].metric:
        return metrics
    raw = data.residuals(calibration, scaled=False)
    z = np.abs(raw.error) / np.hypot(std_of(calibration, raw), raw.noise)
    return {**metrics, "coverage_without_scaling": coverage(z)}


def _scale(data: Data, calibration: Calibration) -> dict[str, float] | None:
    """True depth over prior depth: median over images, and the spread of its log."""
    if isinstance(data, NormalData):
        return None
    scales = data.residuals(calibration).scales
    median = float(np.median(scales))
    spread = MAD_TO_STD * float(np.median(np.abs(scales - median)))
    return {"median": float(np.exp(median)), "log_spread": spread}


def _intervals(
    residuals: Residuals, fit: Fit, count: int, rng: np.random.Generator
) -> dict[str, list[float]]:
    """95 % intervals of what the fit determines; angles in degrees."""
    if count == 0 or residuals.images < 2:
        return {}
    low, high = np.percentile(bootstrap(residuals, fit, count, rng), _INTERVAL, axis=0)
    intervals = {
        name: [float(low[j]), float(high[j])]
        for j, name in enumerate(fit.names)
        if fit.shares[j] >= DOMINANT_SHARE
    }
    if fit.edge_ratio is not None:
        intervals["edge_std_scale"] = [float(low[-1]), float(high[-1])]
    if "std_floor_deg" in intervals:
        intervals["std_floor_deg"] = [float(np.degrees(v)) for v in intervals["std_floor_deg"]]
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


def _names(data: Data) -> list[str]:
    return [image.name for image in data.samples]


def _warnings(
    training: Data, held_out: Int64, intervals: dict[str, list[float]], fit: Fit
) -> list[str]:
    warnings = []
    count = len(training.samples)
    if count < FEW_IMAGES:
        warnings.append(f"fitted on only {count} images: too few to know how images differ")
    if not len(held_out):
        warnings.append("no image is held out: the metrics are of the images it was fitted on")
    for name, (low, high) in intervals.items():
        if high - low > WIDE_INTERVAL * (high + low):
            warnings.append(f"{name} is between {low:.3g} and {high:.3g}: more images are needed")
    if fit.gross > MANY_GROSS:
        warnings.append(
            f"{fit.gross:.0%} of the errors are gross: is the truth of these images right?"
        )
    return warnings
