"""Model selection: fit calibration models of growing complexity and select the best.

A more complex calibration model must improve the mean log density by more than two standard errors
over the images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from mpsfm_core.calibration.samples import (
    GROSS_DEPTH,
    DepthSamples,
    NormalSamples,
    Residuals,
    depth_residuals,
    normal_residuals,
)
from mpsfm_core.calibration.std_likelihood import DOMINANT_SHARE, StdFit, fit_std
from mpsfm_core.data import Float64, Int64
from mpsfm_core.providers.uncertainty.calibration import (
    Calibration,
    DepthCalibration,
    NormalCalibration,
)

Alignment = Literal["scale", "scale-shift", "disparity"]
"""Alignment of prior to true depth by scale, scale and depth shift, or scale and inverse depth
shift."""

EDGE_RATIOS = (1.05, 1.1, 1.2)
"""Candidate ratios of neighboring depths at depth edges, larger than on slanted planes [ours]."""
SHIFT_RANGE = (-0.95, 5.0)
"""Range of candidate shifts in units of the depth map's median [ours]."""
DEFAULT_FLOOR = 0.02
"""Default minimum of the depth std in meters, if the data do not determine it [paper, appendix
C]."""
MIN_GAIN_STD_ERRORS = 2.0
"""Minimum log density gain of a more complex model in standard errors [ours]."""
MIN_GAIN = 1e-3
"""Minimum gain of the mean log density, less than the loss from a std error of 2 % [ours]."""
_NUM_DIGITS = 4
_NUM_SHIFTS = 61
_SPACES: Mapping[Alignment, Literal["depth", "disparity"]] = {
    "scale-shift": "depth",
    "disparity": "disparity",
}


@dataclass(frozen=True, eq=False)
class Candidate:
    """Candidate of model selection: a fitted calibration model."""

    name: str
    """Short description of the calibration model for the report."""
    fit: StdFit
    """Maximum-likelihood fit of the std to the errors."""
    calibration: Calibration
    """Calibration with the fitted std parameters."""
    gain: float
    """Gain of the mean log density over the previously selected model; 0 for the first model."""
    standard_error: float
    """Standard error of ``gain`` over the images; 0 for the first model."""
    chosen: bool
    """True if the model is better than all simpler models."""


def std_of(calibration: Calibration, residuals: Residuals) -> Float64:
    """Compute the declared std (n,) of log depth, or of normals in rad, of a calibration."""
    if isinstance(calibration, DepthCalibration):
        factors = {
            "std_scale": calibration.std_scale * calibration.use_network_variance,
            "relative_std": calibration.relative_std,
            "std_floor": calibration.std_floor,
        }
        ratio, edge_scale = calibration.edge_ratio, calibration.edge_std_scale
    else:
        network = calibration.use_network_variance and "std_scale" in residuals.names
        floor = calibration.std_floor_deg
        constant = floor if network else max(floor, calibration.std_default_deg)
        factors = {
            "std_scale": calibration.std_scale * network,
            "std_floor_deg": np.radians(constant),
        }
        ratio, edge_scale = None, 1.0
    std = (residuals.terms * [factors[name] for name in residuals.names]).max(axis=1)
    if ratio is not None:
        std = np.where(residuals.step > np.log(ratio), edge_scale * std, std)
    floored: Float64 = np.maximum(std, 1e-6)
    return floored


@dataclass(frozen=True, eq=False)
class DepthData:
    """Samples of prior and true depth, one entry per image.

    ``alignments`` are the candidate alignments, the simplest first. ``in_meters`` is True if the
    true depth is in meters.
    """

    samples: tuple[DepthSamples, ...]
    alignments: tuple[Alignment, ...] = ("scale",)
    in_meters: bool = True

    def of(self, images: Int64) -> DepthData:
        """Return the samples of a subset of the images."""
        return replace(self, samples=tuple(self.samples[i] for i in images))

    def residuals(self, calibration: Calibration, *, scaled: bool = True) -> Residuals:
        """Compute depth errors after the shift and, if `scaled`, after scaling each image."""
        assert isinstance(calibration, DepthCalibration)
        return depth_residuals(self.samples, calibration, scaled=scaled)

    def fit(self) -> list[Candidate]:
        """Fit candidates with growing complexity of alignment, then std terms, then depth edges."""
        floor = ("std_floor",) * self.samples[0].metric
        search = _ModelSearch()
        for alignment in self.alignments:
            model = _shift(self.samples, alignment)
            names = ("relative_std", *floor)
            attempt = _CandidateModel(model, self.residuals(model), names)
            search.offer(f"{' + '.join(names)}, aligned by {alignment}", [attempt])
        if "std_scale" in search.best.residuals.names:
            for names in (("std_scale", *floor), ("std_scale", "relative_std", *floor)):
                search.offer(" + ".join(names), [search.best._replace(names=names)])
        with_edges = [search.best._replace(edge_ratio=ratio) for ratio in EDGE_RATIOS]
        search.offer("more at depth edges", with_edges)
        return search.candidates


@dataclass(frozen=True, eq=False)
class NormalData:
    """Samples of prior and true normals, one entry per image."""

    samples: tuple[NormalSamples, ...]

    def of(self, images: Int64) -> NormalData:
        """Return the samples of a subset of the images."""
        return replace(self, samples=tuple(self.samples[i] for i in images))

    def residuals(self, calibration: Calibration, *, scaled: bool = True) -> Residuals:
        """Compute normal errors along both tangent directions (normals have no scale)."""
        return normal_residuals(self.samples)

    def fit(self) -> list[Candidate]:
        """Fit a constant std and, if the network predicts a std, its scaled std with a floor."""
        base = NormalCalibration()
        residuals = self.residuals(base)
        search = _ModelSearch()
        constant = _CandidateModel(base, residuals, ("std_floor_deg",))
        search.offer("constant", [constant])
        if "std_scale" in residuals.names:
            search.offer("std_scale + std_floor_deg", [constant._replace(names=residuals.names)])
        return search.candidates


def select_candidate(candidates: Sequence[Candidate]) -> Candidate:
    """Return the selected candidate, the last that is better than all simpler candidates."""
    return next(c for c in reversed(candidates) if c.chosen)


def calibration_from_fit(base: Calibration, fit: StdFit) -> Calibration:
    """Convert a std fit to a calibration with the depth shift of `base`, rounded to four digits.

    The std is the maximum of several terms. The calibration omits terms that are rarely the
    largest, because the data do not determine them. A std floor that the data do not determine has
    the default value.
    """
    factors = {
        name: round_significant(value)
        for name, value, share in zip(fit.names, fit.values, fit.shares, strict=True)
        if share >= DOMINANT_SHARE
    }
    network = {
        "std_scale": factors.get("std_scale", 1.0),
        "use_network_variance": "std_scale" in factors,
    }
    if isinstance(base, NormalCalibration):
        floor = round_significant(np.degrees(factors.get("std_floor_deg", 0.0)))
        if "std_scale" in factors:
            return NormalCalibration(**network, std_floor_deg=floor)
        floor_default = min(NormalCalibration().std_floor_deg, floor)
        return NormalCalibration(**network, std_floor_deg=floor_default, std_default_deg=floor)
    limits = dict(zip(fit.names, fit.limits, strict=True))
    floor_default = min(DEFAULT_FLOOR, limits.get("std_floor", DEFAULT_FLOOR))
    return DepthCalibration(
        **network,
        relative_std=factors.get("relative_std", 0.0),
        std_floor=factors.get("std_floor", round_significant(floor_default)),
        shift=round_significant(base.shift),
        shift_space=base.shift_space,
        edge_ratio=fit.edge_ratio,
        edge_std_scale=round_significant(fit.edge_scale),
    )


class _CandidateModel(NamedTuple):
    """Calibration model to fit, with the depth shift of the alignment in `base`."""

    base: Calibration
    residuals: Residuals
    names: tuple[str, ...]
    edge_ratio: float | None = None


class _ModelSearch:
    """Search for the best calibration model, from simple to complex models."""

    def __init__(self) -> None:
        self.candidates: list[Candidate] = []
        self.best: _CandidateModel
        self._density: Float64 | None = None

    def offer(self, name: str, attempts: Sequence[_CandidateModel]) -> None:
        """Fit variants of a model; select the most likely if better than the selected model."""
        fits = [fit_std(a.residuals, a.names, a.edge_ratio) for a in attempts]
        place = int(np.argmax([fit.log_density.mean() for fit in fits]))
        attempt, fit = attempts[place], fits[place]
        gain, error = 0.0, 0.0
        if self._density is not None:
            differences = fit.log_density - self._density
            gain, error = float(differences.mean()), _standard_error(differences)
        chosen = self._density is None or gain > max(MIN_GAIN_STD_ERRORS * error, MIN_GAIN)
        calibration = calibration_from_fit(attempt.base, fit)
        self.candidates.append(Candidate(name, fit, calibration, gain, error, chosen))
        if chosen:
            self.best, self._density = attempt, fit.log_density


def _standard_error(values: Float64) -> float:
    """Return the standard error of the mean of values; infinite for a single value."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.inf


def _shift(samples: Sequence[DepthSamples], alignment: Alignment) -> DepthCalibration:
    """Find the depth or inverse depth shift with the smallest mean error of log depth."""
    if alignment == "scale":
        return DepthCalibration()
    space = _SPACES[alignment]

    def loss(shift: float) -> float:
        return _shift_loss(samples, DepthCalibration(shift=shift, shift_space=space))

    grid = np.linspace(*SHIFT_RANGE, _NUM_SHIFTS)
    losses = [loss(shift) for shift in grid]
    place = int(np.argmin(losses))
    around = (grid[max(place - 1, 0)], grid[min(place + 1, _NUM_SHIFTS - 1)])
    shift = float(minimize_scalar(loss, bounds=around, method="bounded").x)
    return DepthCalibration(shift=shift, shift_space=space)


def _shift_loss(samples: Sequence[DepthSamples], model: DepthCalibration) -> float:
    """Compute the mean absolute error of log depth; non-positive depth counts as gross error."""
    residuals = depth_residuals(samples, model)
    lost = sum(len(image.prior) for image in samples) - len(residuals)
    return float((np.abs(residuals.error).sum() + lost * GROSS_DEPTH) / (len(residuals) + lost))


def round_significant(value: float) -> float:
    """Round a value to four significant digits."""
    return float(f"{value:.{_NUM_DIGITS}g}")
