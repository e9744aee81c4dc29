"""Gaussian fusion of stereo depth with the mapper's refined depth, and posterior std.

:mod:`mpsfm_core.dense.depth_completion` corrects input depth at pixels without stereo measurement.
The error of the log of input depth is modeled as a Gaussian Markov random field on the pixels
(Lindgren et al., 2011). The posterior std of input depth is lower near pixels with stereo depth,
and equals the prior std far from such pixels. The planarity prior does not lower the posterior std,
because a surface without stereo depth often lies behind another surface instead of continuing it.
"""

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
from mpsfm_core.optimize.depth_variance import compute_inverse_diagonal

_DOWNSAMPLING = 8
"""Downsampling factor of the pixel grid on which the random field of depth errors is solved."""
_MIN_MEASURED_RATIO = 0.3
"""Minimum ratio of pixels with stereo depth in a used block; single pixels may be wrong [ours]."""
_MIN_KNOWN_ERROR_RATIO = 0.5
"""Minimum ratio of the estimated std of input depth to the distance between input and stereo depth
[ours].

The std of stereo depth is known with a relative accuracy of about 1/8."""
MIN_STD = 1e-4
"""Minimum std of log depth, below that of any depth sensor."""
UNKNOWN_LOG_STD = 1.0
"""Std of log depth in holes, whose depth is filled from neighboring pixels."""


class LogDepthMap(NamedTuple):
    """Map of log depth and its std."""

    log_depth: Float32
    """(h, w) natural log of z-depth in world units."""
    log_std: Float32
    """(h, w) std of the log depth, infinite at pixels without depth."""

    @property
    def known(self) -> Bool:
        """(h, w) mask of pixels with depth, whose std is finite."""
        return np.isfinite(self.log_std)

    def with_min_std(self, mask: Bool, log_std: float) -> LogDepthMap:
        """Raise the std of log depth at the pixels of a mask (h, w) to a minimum."""
        raised = np.maximum(self.log_std, np.float32(log_std))
        return LogDepthMap(self.log_depth, np.where(mask, raised, self.log_std))


def fuse_known_depth(measured: LogDepthMap, known: LogDepthMap) -> LogDepthMap:
    """Fuse stereo depth with input depth at the same pixels.

    The variance of input depth is estimated as the mean squared distance to stereo depth minus
    the variance of stereo depth. The estimated variance of accurate sensor depth may be far below
    the variance that its prior declares. Filled holes of the input depth are not fused.
    """
    compared = measured.known & (known.log_std < UNKNOWN_LOG_STD)
    if not compared.any():
        return measured
    distance = np.abs(measured.log_depth - known.log_depth)[compared]
    distance_std = np.quantile(distance, ONE_SIGMA)
    measured_std = np.median(measured.log_std[compared])
    known_variance = max(
        float(distance_std**2 - measured_std**2),
        float(_MIN_KNOWN_ERROR_RATIO * distance_std) ** 2,
    )
    known_std = np.float32(max(known_variance**0.5, MIN_STD))
    measured_precision, known_precision = measured.log_std**-2.0, known_std**-2.0
    total = measured_precision + known_precision
    mean = (measured_precision * measured.log_depth + known_precision * known.log_depth) / total
    return LogDepthMap(
        np.where(compared, mean, measured.log_depth).astype(np.float32),
        np.where(compared, total**-0.5, measured.log_std).astype(np.float32),
    )


def compute_depth_posterior(
    known: LogDepthMap, measured: LogDepthMap, correlation_px: float
) -> LogDepthMap:
    """Compute log depth and its std at every pixel from input depth and stereo depth.

    Args:
        known: Input depth, with holes filled from neighboring pixels.
        measured: Stereo depth after :func:`fuse_known_depth`.
        correlation_px: Correlation length of the error of input depth in pixels.
    """
    height, width = known.log_depth.shape
    grid = max(2, width // _DOWNSAMPLING), max(2, height // _DOWNSAMPLING)
    length = max(correlation_px / _DOWNSAMPLING, 1.0)
    mask = measured.known
    std = resize_map(known.log_std**-2.0, *grid) ** -0.5
    correlation = _error_correlation(known.log_std, resize_map(std, width, height, linear=False))
    weight = np.where(mask, correlation / measured.log_std**2, 0).astype(np.float32)
    block_measured = resize_map(mask.astype(np.float32), *grid) > _MIN_MEASURED_RATIO
    precision = np.where(block_measured, resize_map(weight, *grid), np.float32(0))
    error = np.where(mask, measured.log_depth - known.log_depth, 0) * weight
    mean = resize_map(error, *grid) / np.where(block_measured, precision, np.float32(1))
    blocks = MeasuredCorrection(np.where(block_measured, mean, np.float32(0)), precision)
    hole = std >= UNKNOWN_LOG_STD
    planarity = estimate_planarity(resize_map(known.log_depth, *grid), hole, blocks, MIN_STD)
    field = _random_field(_calibrated_std(known, measured, std), length)
    correction = solve_depth_correction(field, planarity, blocks)
    east, south, mass = _random_field(std, length)
    variance = compute_inverse_diagonal(east, south, mass + precision)
    correlation = _error_correlation(known.log_std, resize_map(std, width, height))
    block_variance = resize_map(variance, width, height)
    posterior_std = np.sqrt(correlation * block_variance + (1 - correlation) * known.log_std**2)
    corrected = known.log_depth + correlation * resize_map(correction, width, height)
    return LogDepthMap(
        np.where(mask, measured.log_depth, corrected),
        np.where(mask, measured.log_std, posterior_std),
    )


def _calibrated_std(known: LogDepthMap, measured: LogDepthMap, std: Float32) -> Float32:
    """Scale the std of input depth to match the distances between input and stereo depth.

    Holes stay unknown.
    """
    compared = measured.known & (known.log_std < UNKNOWN_LOG_STD)
    if not compared.any():
        return std
    distance = np.abs(measured.log_depth - known.log_depth)[compared] / known.log_std[compared]
    scaled = np.maximum(std * np.float32(np.quantile(distance, ONE_SIGMA)), np.float32(MIN_STD))
    return np.where(std < UNKNOWN_LOG_STD, scaled, std)


def _error_correlation(pixel_std: Float32, block_std: Float32) -> Float32:
    """Return the assumed correlation in [0, 1] of a pixel's depth error with its block's error.

    The error correlation is low if the depth stds of pixel and block differ much.
    """
    correlation: Float32 = np.minimum(pixel_std / block_std, block_std / pixel_std) ** 2
    return correlation


def _random_field(std: Float32, length: float) -> tuple[Float32, Float32, Float32]:
    """Compute the precision maps of a Gaussian Markov random field with a marginal std.

    The function returns the precisions (couplings) of differences to the right and lower neighbor,
    and the precision (mass) of each value. On an unbounded grid the variance of the field is about
    ``log(3 length) / (2 pi coupling)`` if the mass is ``coupling / length^2``.

    Args:
        std: (h, w) marginal std of the random field.
        length: Correlation length of the random field in pixels.
    """
    strength = (np.log(3 * length) / (2 * np.pi * std**2)).astype(np.float32)
    east, south = np.zeros_like(strength), np.zeros_like(strength)
    east[:, :-1] = np.minimum(strength[:, 1:], strength[:, :-1])
    south[:-1] = np.minimum(strength[1:], strength[:-1])
    return east, south, (strength / length**2).astype(np.float32)
