"""Joins what the photos say with what was known before, and says how sure that is.

Known depth is moved everywhere as :mod:`mpsfm_core.dense.depth_completion` says. Its std is that of
a smooth random field, the error of known log depth, which hangs together over some distance: the
declared one where nothing was measured near, and less where measured depth observes it. The field
is a Gaussian Markov random field (Lindgren et al., 2011): one sparse system on the pixels. That
surfaces are flat lowers no std: what was not measured often lies behind an edge."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32
from mpsfm_core.dense.depth_completion import (
    MeasuredCorrection,
    estimate_planarity,
    solve_depth_correction,
)
from mpsfm_core.geometry import resize_map
from mpsfm_core.geometry.statistics import ONE_SIGMA
from mpsfm_core.optimize.depth_variance import inverse_diagonal

_REDUCTION = 8
"""Of the grid that the field lives on."""
_ENOUGH = 0.3
"""Share of the pixels of a block above which it counts as measured: single ones that other views
confirm may agree by chance (ours; 0.2 to 0.6 do as well)."""
_LEAST_LEFT = 0.5
"""Of a distance between known and measured depth, what the known one has of it at least: the std of
the measured one is not told to better than an eighth. With true depth as the prior 69 % of the
pixels of rendered_kitchen are then within their std, 88 % with all of the distance (ours)."""
MIN_STD = 1e-4
"""Of log depth that is known: no sensor is better."""


UNKNOWN_LOG_STD = 1.0
"""Of depth that nothing is known of but what is around."""


class LogDepthMap(NamedTuple):
    """Measured log depth and its std, (h, w) float32; not measured where the std is infinite."""

    log_depth: Float32
    log_std: Float32

    @property
    def known(self) -> Bool:
        """(h, w), where something was measured."""
        return np.isfinite(self.log_std)


def fuse_known_depth(measured: LogDepthMap, known: LogDepthMap) -> LogDepthMap:
    """What was measured, joined with what was known at the same pixels.

    The std of the known depth is taken as its distance to the measured one says, less the noise of
    the latter. That may be far less than it declares: depth of a sensor must not suffer.
    Holes say nothing of it, and nothing is joined there.
    """
    compared = measured.known & (known.log_std < UNKNOWN_LOG_STD)
    if not compared.any():
        return measured
    distance = np.abs(measured.log_depth - known.log_depth)[compared]
    both, own = np.quantile(distance, ONE_SIGMA), np.median(measured.log_std[compared])
    left = max(float(both**2 - own**2), float(_LEAST_LEFT * both) ** 2)
    std = np.float32(max(left**0.5, MIN_STD))
    ours, theirs = measured.log_std**-2.0, std**-2.0
    total = ours + theirs
    mean = (ours * measured.log_depth + theirs * known.log_depth) / total
    return LogDepthMap(
        np.where(compared, mean, measured.log_depth).astype(np.float32),
        np.where(compared, total**-0.5, measured.log_std).astype(np.float32),
    )


def compute_depth_posterior(
    known: LogDepthMap, measured: LogDepthMap, correlation_px: float
) -> LogDepthMap:
    """Log depth everywhere: ``known`` before, moved by what was ``measured``.

    ``correlation_px``: distance over which errors of the known depth hang together.
    """
    height, width = known.log_depth.shape
    small = max(2, width // _REDUCTION), max(2, height // _REDUCTION)
    length = max(correlation_px / _REDUCTION, 1.0)
    which = measured.known
    std = resize_map(known.log_std**-2.0, *small) ** -0.5
    told = _alike(known.log_std, resize_map(std, width, height, linear=False))
    weight = np.where(which, told / measured.log_std**2, 0).astype(np.float32)
    enough = resize_map(which.astype(np.float32), *small) > _ENOUGH
    precision = np.where(enough, resize_map(weight, *small), np.float32(0))
    error = np.where(which, measured.log_depth - known.log_depth, 0) * weight
    mean = resize_map(error, *small) / np.where(enough, precision, np.float32(1))
    found = MeasuredCorrection(np.where(enough, mean, np.float32(0)), precision)
    hole = std >= UNKNOWN_LOG_STD
    flat = estimate_planarity(resize_map(known.log_depth, *small), hole, found, MIN_STD)
    correction = solve_depth_correction(
        _field(_found_std(known, measured, std), length), flat, found
    )
    east, south, mass = _field(std, length)
    variance = inverse_diagonal(east, south, mass + precision)
    alike = _alike(known.log_std, resize_map(std, width, height))
    here = resize_map(variance, width, height)
    spread = np.sqrt(alike * here + (1 - alike) * known.log_std**2)
    moved = known.log_depth + alike * resize_map(correction, width, height)
    return LogDepthMap(
        np.where(which, measured.log_depth, moved),
        np.where(which, measured.log_std, spread),
    )


def _found_std(known: LogDepthMap, measured: LogDepthMap, std: Float32) -> Float32:
    """The declared ``std`` of known depth on any grid, as large as its distances to measured depth
    say it is; holes stay unknown."""
    compared = measured.known & (known.log_std < UNKNOWN_LOG_STD)
    if not compared.any():
        return std
    distance = np.abs(measured.log_depth - known.log_depth)[compared] / known.log_std[compared]
    found = np.maximum(std * np.float32(np.quantile(distance, ONE_SIGMA)), np.float32(MIN_STD))
    return np.where(std < UNKNOWN_LOG_STD, found, std)


def _alike(std: Float32, other: Float32) -> Float32:
    """What the errors of a pixel and of its block say of each other, 0 to 1: little where far less
    is known of one of them."""
    alike: Float32 = np.minimum(std / other, other / std) ** 2
    return alike


def _field(std: Float32, length: float) -> tuple[Float32, Float32, Float32]:
    """Couplings (east, south) and mass of a field of this std and correlation length in pixels.

    In the plane the variance of such a field is about log(3 length) / (2 pi coupling), the mass
    coupling / length^2.
    """
    strength = (np.log(3 * length) / (2 * np.pi * std**2)).astype(np.float32)
    east, south = np.zeros_like(strength), np.zeros_like(strength)
    east[:, :-1] = np.minimum(strength[:, 1:], strength[:, :-1])
    south[:-1] = np.minimum(strength[1:], strength[:-1])
    return east, south, (strength / length**2).astype(np.float32)
