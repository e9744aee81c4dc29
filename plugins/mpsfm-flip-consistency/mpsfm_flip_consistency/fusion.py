"""Mean and variance of the predictions for an image and its mirror (paper, appendix B).

The covariance of depth or normals is the unbiased sample covariance of the two predictions. The
sample covariance of two predictions is the sum of the outer products of their deviations from the
mean. If the network predicts a variance, the fused variance is the maximum of predicted and sample
variance. The errors of the predictions for an image and its mirror are correlated, so the variance
of the mean prediction is not halved.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core import DepthPrior, NormalPrior
from mpsfm_core.data import Bool, Float32, Float64

_SMALLEST_RELATIVE_STD = 1e-4
"""Minimum std of depth relative to depth. The minimum std keeps the variance positive if both
predictions agree."""
_SMALLEST_STD_RAD = 1e-3


def fuse_depth(first: DepthPrior, second: DepthPrior) -> DepthPrior:
    """Fuse two depth maps of a view into one prior that is valid where both maps are valid.

    The mean depth is weighted by the inverse network variances if both maps have variances
    [reference], else both maps have the same weight.
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
    """Fuse two normal maps of a view into one prior that is valid where both maps are valid.

    The mean normal is the normalized sum of both normals. Both normals deviate from the mean normal
    by half of the angle between them, in opposite directions. The covariance of both normals in the
    tangent plane has the eigenvalues ``angle**2 / 2`` and 0, where ``angle`` is the angle between
    the normals. A :class:`NormalPrior` has one variance for both tangent directions, which is half
    of the trace, ``angle**2 / 4``.
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
    """Stack two maps as (2, h, w) float64, with 1 at invalid pixels."""
    return np.where(valid, np.stack([first, second]).astype(np.float64), 1.0)
