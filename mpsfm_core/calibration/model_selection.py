"""Choosing and fitting the calibration of a kind of prior.

Several models are fitted, from the simplest on. A richer one is taken only when it explains the
errors better by more than two standard errors over the images.
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
"""What an image's depth is unknown up to: a factor; and a shift of depth, or of inverse depth."""

EDGE_RATIOS = (1.05, 1.1, 1.2)
"""Ratios of neighbouring depths that are tried as edges (ours; a slanted plane on a coarse map
has steps of 2 or 3 %)."""
SHIFT_RANGE = (-0.95, 5.0)
"""Of shifts, in medians of the map (ours)."""
DEFAULT_FLOOR = 0.02
"""Metres, where the data do not determine the floor (paper appendix C)."""
CLEARLY = 2.0
"""Standard errors by which a richer model must be better (ours)."""
MIN_GAIN = 1e-3
"""Of the mean log density (ours): a std that is 2 % off costs less."""
_DIGITS = 4
_GRID = 61
_SPACES: Mapping[Alignment, Literal["depth", "disparity"]] = {
    "scale-shift": "depth",
    "disparity": "disparity",
}


@dataclass(frozen=True, eq=False)
class Candidate:
    """One model that was tried. ``gain``: of the mean log density over the one chosen before it,
    with its standard error over images; both 0 for the first."""

    name: str
    fit: StdFit
    calibration: Calibration
    gain: float
    standard_error: float
    chosen: bool


def std_of(calibration: Calibration, residuals: Residuals) -> Float64:
    """The std that a calibration declares for these errors, (n,), of log depth or in rad."""
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
    """Samples of depth priors, one entry an image.

    ``alignments``: what may be tried, the simplest first. ``in_meters``: whether the truth is.
    """

    samples: tuple[DepthSamples, ...]
    alignments: tuple[Alignment, ...] = ("scale",)
    in_meters: bool = True

    def of(self, images: Int64) -> DepthData:
        """The data of some images."""
        return replace(self, samples=tuple(self.samples[i] for i in images))

    def residuals(self, calibration: Calibration, *, scaled: bool = True) -> Residuals:
        """Errors after the calibration's shift and, if ``scaled``, each image's own scale."""
        assert isinstance(calibration, DepthCalibration)
        return depth_residuals(self.samples, calibration, scaled=scaled)

    def fit(self) -> list[Candidate]:
        """StdFit alignment, terms and edges in this order; :func:`select_candidate` is the result."""
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
    """Samples of normal priors, one entry an image."""

    samples: tuple[NormalSamples, ...]

    def of(self, images: Int64) -> NormalData:
        """The data of some images."""
        return replace(self, samples=tuple(self.samples[i] for i in images))

    def residuals(self, calibration: Calibration, *, scaled: bool = True) -> Residuals:
        """Errors along both tangent directions; normals have no scale."""
        return normal_residuals(self.samples)

    def fit(self) -> list[Candidate]:
        """StdFit a constant std, and a scale of the network's own with a floor if it has one."""
        base = NormalCalibration()
        residuals = self.residuals(base)
        search = _ModelSearch()
        constant = _CandidateModel(base, residuals, ("std_floor_deg",))
        search.offer("constant", [constant])
        if "std_scale" in residuals.names:
            search.offer("std_scale + std_floor_deg", [constant._replace(names=residuals.names)])
        return search.candidates


def select_candidate(candidates: Sequence[Candidate]) -> Candidate:
    """The chosen model: the last that was better than all before it."""
    return next(c for c in reversed(candidates) if c.chosen)


def calibration_from_fit(base: Calibration, fit: StdFit) -> Calibration:
    """A fit as a calibration, with the shift of ``base``, round_significant to four digits.

    What the data do not determine, as it is the largest nearly nowhere, is left out; a floor is
    then the usual one.
    """
    found = {
        name: round_significant(value)
        for name, value, share in zip(fit.names, fit.values, fit.shares, strict=True)
        if share >= DOMINANT_SHARE
    }
    network = {
        "std_scale": found.get("std_scale", 1.0),
        "use_network_variance": "std_scale" in found,
    }
    if isinstance(base, NormalCalibration):
        floor = round_significant(np.degrees(found.get("std_floor_deg", 0.0)))
        if "std_scale" in found:
            return NormalCalibration(**network, std_floor_deg=floor)
        usual = min(NormalCalibration().std_floor_deg, floor)
        return NormalCalibration(**network, std_floor_deg=usual, std_default_deg=floor)
    limits = dict(zip(fit.names, fit.limits, strict=True))
    usual = min(DEFAULT_FLOOR, limits.get("std_floor", DEFAULT_FLOOR))
    return DepthCalibration(
        **network,
        relative_std=found.get("relative_std", 0.0),
        std_floor=found.get("std_floor", round_significant(usual)),
        shift=round_significant(base.shift),
        shift_space=base.shift_space,
        edge_ratio=fit.edge_ratio,
        edge_std_scale=round_significant(fit.edge_scale),
    )


class _CandidateModel(NamedTuple):
    """A model to fit: ``base`` has its shift."""

    base: Calibration
    residuals: Residuals
    names: tuple[str, ...]
    edge_ratio: float | None = None


class _ModelSearch:
    """Tries models of growing richness and remembers the best."""

    def __init__(self) -> None:
        self.candidates: list[Candidate] = []
        self.best: _CandidateModel
        self._density: Float64 | None = None

    def offer(self, name: str, attempts: Sequence[_CandidateModel]) -> None:
        """StdFit variants of one model; take the likeliest if it is better than the best so far."""
        fits = [fit_std(a.residuals, a.names, a.edge_ratio) for a in attempts]
        place = int(np.argmax([fit.log_density.mean() for fit in fits]))
        attempt, fit = attempts[place], fits[place]
        gain, error = 0.0, 0.0
        if self._density is not None:
            differences = fit.log_density - self._density
            gain, error = float(differences.mean()), _standard_error(differences)
        chosen = self._density is None or gain > max(CLEARLY * error, MIN_GAIN)
        calibration = calibration_from_fit(attempt.base, fit)
        self.candidates.append(Candidate(name, fit, calibration, gain, error, chosen))
        if chosen:
            self.best, self._density = attempt, fit.log_density


def _standard_error(values: Float64) -> float:
    """Of the mean; infinite for a single value, which shows no spread."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.inf


def _shift(samples: Sequence[DepthSamples], alignment: Alignment) -> DepthCalibration:
    """The model with the shift that leaves the smallest mean error of log depth."""
    if alignment == "scale":
        return DepthCalibration()
    space = _SPACES[alignment]

    def loss(shift: float) -> float:
        return _shift_loss(samples, DepthCalibration(shift=shift, shift_space=space))

    grid = np.linspace(*SHIFT_RANGE, _GRID)
    losses = [loss(shift) for shift in grid]
    place = int(np.argmin(losses))
    around = (grid[max(place - 1, 0)], grid[min(place + 1, _GRID - 1)])
    shift = float(minimize_scalar(loss, bounds=around, method="bounded").x)
    return DepthCalibration(shift=shift, shift_space=space)


def _shift_loss(samples: Sequence[DepthSamples], model: DepthCalibration) -> float:
    """Mean absolute error of log depth; a pixel whose depth the shift destroys is grossly wrong."""
    residuals = depth_residuals(samples, model)
    lost = sum(len(image.prior) for image in samples) - len(residuals)
    return float((np.abs(residuals.error).sum() + lost * GROSS_DEPTH) / (len(residuals) + lost))


def round_significant(value: float) -> float:
    """A value to four significant digits: more would pretend."""
    return float(f"{value:.{_DIGITS}g}")
