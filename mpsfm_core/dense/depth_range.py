"""Depth prior from the sparse points of an image, for COLMAP models without depth maps."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, Float64

_GRID = (8, 8)
"""Shape of the constant depth map of the prior, which has no influence on the results."""
_RANGE_PERCENTILES = (2.0, 98.0)
"""Percentiles of the points' depths that bound the depth range, without possible outliers."""
_RANGE_STDS = 1.5
"""Half width of the depth range in stds of the depth prior."""
_MIN_LOG_STD = 0.1
"""Minimum std of the prior's log depth."""


def depth_prior_from_points(depths: Float64) -> DepthPrior | None:
    """Build a constant depth prior whose std covers the depths of an image's points.

    Args:
        depths: (n,) depths of the points in the camera frame, world units.

    Returns:
        The depth prior, or None without points in front of the camera.
    """
    positive = depths[depths > 0]
    if not len(positive):
        return None
    near, far = np.log(np.percentile(positive, _RANGE_PERCENTILES))
    depth = np.full(_GRID, np.exp((near + far) / 2), np.float32)
    std = max((far - near) / 2 / _RANGE_STDS, _MIN_LOG_STD)
    return DepthPrior.from_arrays(depth, (std * depth) ** 2, metric=False)
