"""What is known of depth when there is no prior: the range of the points that an image sees."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, Float64

_GRID = (8, 8)
"""The map is the same everywhere, so its grid does not matter."""
_RANGE = (2.0, 98.0)
"""Percentiles of the depth of points; beyond lie the wrong ones."""
_RANGE_STDS = 1.5
"""Std that the range reaches to either side; the search goes a little further."""
_MIN_LOG_STD = 0.1


def depth_prior_from_points(depths: Float64) -> DepthPrior | None:
    """One depth for the whole image, with a std that covers the points' (n,) depths.

    None without points in front of the camera.
    """
    ahead = depths[depths > 0]
    if not len(ahead):
        return None
    near, far = np.log(np.percentile(ahead, _RANGE))
    depth = np.full(_GRID, np.exp((near + far) / 2), np.float32)
    std = max((far - near) / 2 / _RANGE_STDS, _MIN_LOG_STD)
    return DepthPrior.from_arrays(depth, (std * depth) ** 2, metric=False)
