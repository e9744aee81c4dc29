"""Comparison of the std of depth and normals with the std that a test network reports."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, Float32, Float64, NormalPrior
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD

STD_FACTOR = 1.25
"""Largest accepted ratio between the returned std and the std that the test network reports. A std
of 0.25 m that is returned as a variance of 0.25 m^2 gives an std ratio of 2."""
STD_SPREAD_FACTOR = 1.5
"""Largest accepted ratio between the returned std and the reported std at the 10 % and 90 %
quantiles of all pixels. A mirrored or averaged std gives an std ratio of 2 where depth varies."""


def require_reported_std(variance: Float32, expected_std: Float64) -> str:
    """Require that the output variance is the square of the std that the test network reports.

    Args:
        variance: Variances (n,) in the output of the provider.
        expected_std: Standard deviations (n,) that the test network reports.

    Returns:
        Message with the median ratio between returned and expected standard deviations.

    Raises:
        CheckFailed: the median ratio of the standard deviations is above :data:`STD_FACTOR` or
            below its inverse.
    """
    ratios = np.sqrt(variance.astype(np.float64)) / expected_std
    low, factor, high = map(float, np.quantile(ratios, (0.1, 0.5, 0.9)))
    if 1 / STD_FACTOR < factor < STD_FACTOR:
        if low < 1 / STD_SPREAD_FACTOR or high > STD_SPREAD_FACTOR:
            raise CheckFailed(
                f"the std is {low:.2g} to {high:.2g} times the std that the test network reports: "
                "the variance belongs to other pixels or is averaged"
            )
        return f"std {factor:.3f} times the reported one"
    if 1 / STD_FACTOR < float(np.median(variance / expected_std)) < STD_FACTOR:
        raise CheckFailed("the variance equals the std: return the squared std")
    raise CheckFailed(f"the std is {factor:.2g} times the std that the test network reports")


def require_depth_std(prior: DepthPrior, example: Example) -> str:
    """Require the depth variance that a test network reports, if the output has a variance."""
    if prior.variance is None:
        return "no variance"
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape))
    expected = RELATIVE_STD * prior.depth[where].astype(np.float64)
    return require_reported_std(prior.variance[where], expected)


def require_normals_std(prior: NormalPrior, example: Example) -> str:
    """Require the normal variance that a test network reports, if the output has a variance."""
    if prior.variance is None:
        return "no variance"
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape))
    expected = np.full(int(where.sum()), NORMALS_STD)
    return require_reported_std(prior.variance[where], expected)
