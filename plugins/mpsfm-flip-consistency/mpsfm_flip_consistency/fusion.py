"""Mean of two passes, and the variance that their disagreement says they have.

Paper appendix B: the covariance is the sum of the outer products of both deviations from the mean,
which for two samples is their unbiased covariance; where the network gives a variance too, the
larger one is taken. Errors of two passes of one network are correlated, so the variance of the
mean is not taken to be smaller than that of one pass.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core import DepthPrior, NormalPrior
from mpsfm_core.data import Bool, Float32, Float64

_SMALLEST_RELATIVE_STD = 1e-4
"""Of depth, where both passes agree exactly: a variance must be positive."""
_SMALLEST_STD_RAD = 1e-3


def fuse_depth(first: DepthPrior, second: DepthPrior) -> DepthPrior:
    """Both passes as one prior, valid where both are.

    With network variances the mean is weighted by their inverses (reference), else both passes
    weigh the same.
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
    """Both passes as one prior, valid where both are; it faces the camera, as both do.

    The mean is the unit vector halfway between both. Both deviate from it by half the angle
    between them, to opposite sides, so their covariance in the tangent plane has the eigenvalues
    ``angle**2 / 2`` along the deviation and 0 across it. A :class:`NormalPrior` has one variance
    for both tangent directions: half the trace, ``angle**2 / 4``, which keeps the total variance.
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
    """Both maps as (2, h, w) float64, 1 where not valid."""
    return np.where(valid, np.stack([first, second]).astype(np.float64), 1.0)
