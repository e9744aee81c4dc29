"""Variance of depth next to depth edges.

A matching window next to a depth edge contains two surfaces, and the stereo depth of its center may
be the depth of either surface. The posterior of such a pixel is a mixture of two depths whose
distance is the depth step across the window. Views that confirm the depth raise its odds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float32
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD, LogDepthMap

_VIEW_ODDS = 2.5
"""Factor by which each confirming view after the first raises the odds of a depth [fitted to
benchmarks.street].

The first view is no evidence, because its window contains the same two surfaces."""
_DIRECTIONS = (0, 1), (1, 0), (1, 1), (1, -1)


def add_edge_variance(
    depth: LogDepthMap, views: NDArray[np.uint16], window_radius: int
) -> LogDepthMap:
    """Add the variance of a mixture of two surfaces next to depth edges.

    The added variance of log depth is ``p (1 - p) step^2``, where ``p`` is the probability of the
    surface across the edge: 1/2 with up to one confirming view, and lower with more views.

    Args:
        depth: Posterior log depth.
        views: (h, w) number of views that confirm the stereo depth of each pixel.
        window_radius: Radius of the matching window in pixels.
    """
    odds = np.float32(_VIEW_ODDS) ** np.maximum(views.astype(np.float32) - 1, 0)
    probability = 1 / (1 + odds)
    step = np.minimum(depth_steps(depth.log_depth, window_radius), UNKNOWN_LOG_STD)
    variance = depth.log_std**2 + probability * (1 - probability) * step**2
    return LogDepthMap(depth.log_depth, np.sqrt(variance).astype(np.float32))


def depth_steps(log_depth: Float32, radius: int) -> Float32:
    """Compute the relative step (h, w) of inverse depth within a radius in pixels.

    With the changes ``a`` and ``b`` of inverse depth to two opposite pixels, the step is
    ``| |a| - |b| |``. The step is 0 on a plane, where ``a = -b``, and on structures that are
    thinner than the radius, where ``a = b``.
    """
    height, width = log_depth.shape
    inverse = np.exp(-log_depth)
    padded = np.pad(inverse, radius, mode="reflect", reflect_type="odd")
    step = np.zeros_like(inverse)
    for down, right in _DIRECTIONS:
        changes = [
            np.abs(padded[row : row + height, column : column + width] - inverse)
            for row, column in (
                (radius * (1 + down), radius * (1 + right)),
                (radius * (1 - down), radius * (1 - right)),
            )
        ]
        np.maximum(step, np.abs(changes[0] - changes[1]), out=step)
    return np.asarray(step / inverse, np.float32)
