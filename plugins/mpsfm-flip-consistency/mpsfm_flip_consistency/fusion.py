"""Mean of two passes, and its variance from their difference (paper, appendix B).

The covariance is the sum of the outer products of both deviations from the mean, which is the
unbiased covariance of two samples. If the network predicts a variance, the larger one is used.
Errors of two passes are correlated, so the variance of the mean is not reduced below that of one
pass.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core import DepthPrior, NormalPrior
from mpsfm_core.data import Bool, Float32, Float64

_SMALLEST_RELATIVE_STD = 1e-4
"""Minimum std relative to depth, because a variance must be positive if both passes agree."""
_SMALLEST_STD_RAD = 1e-3


def fuse_depth(first: DepthPrior, second: DepthPrior) -> DepthPrior:
    """Fuse two depth maps to one prior that is valid where both are.

    The mean is weighted by the inverse network variances if both have one [reference], else
    equally.
    """
    valid = first.valid & second.valid
    depths = _stack(first.depth, second.depth, valid)
    if first.variance is None or second.variance is None:
        mean = depths.mean(axis=0)
        network = np.zeros_like(mean)
    else:
        variances = _stack(first.variance, second.variance, valid)
        weights = variances[::-1] / variances.sum(axis=0)
        mean, network = (weights * depths).sum(axis=0), (weights * variances).sum(axis=0)
    disagreement = ((depths - mean) ** 2).sum(axis=0)
    floor = (_SMALLEST_RELATIVE_STD * mean) ** 2
    variance = np.maximum(np.maximum(disagreement, network), floor)
    return DepthPrior.from_arrays(mean, variance, valid, metric=first.metric and second.metric)


def fuse_normals(first: NormalPrior, second: NormalPrior) -> NormalPrior:
    """Fuse two normal maps to one prior that is valid where both are.

    The mean is the normalized sum. Both normals deviate from it by half of their angle, in opposite
    directions, so their covariance in the tangent plane has the eigenvalues ``angle**2 / 2`` and 0.
    A :class:`NormalPrior` has one variance for both tangent directions: half of the trace,
    ``angle**2 / 4``.
    """
    valid = first.valid & second.valid
    total = first.normals.astype(np.float64) + second.normals
    length = np.linalg.norm(total, axis=-1)
    apart = np.linalg.norm(first.normals.astype(np.float64) - second.normals, axis=-1)
    angle = 2 * np.arctan2(apart, length)
    variance = np.maximum(angle**2 / 4, _SMALLEST_STD_RAD**2)
    if first.variance is not None and second.variance is not None:
        variance = np.maximum(variance, _stack(first.variance, second.variance, valid).mean(axis=0))
    return NormalPrior.from_arrays(total, variance, valid)


def _stack(first: Float32, second: Float32, valid: Bool) -> Float64:
    """Stack both maps as (2, h, w) float64, with 1 at invalid pixels."""
    return np.where(valid, np.stack([first, second]).astype(np.float64), 1.0)
