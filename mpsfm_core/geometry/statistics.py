"""Robust statistics."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, Int64

MAD_TO_STD = 1.4826
"""Std of normal errors relative to the median of their absolute values."""
ONE_SIGMA = 0.683
"""Probability within one std of a normal distribution."""


def weighted_quantile(values: Float64, weights: Float64, ratio: float) -> float:
    """Return the value below which this ratio of the total weight falls; both (n,)."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    position = int(np.searchsorted(cumulative, ratio * cumulative[-1]))
    return float(values[order[min(position, len(order) - 1)]])


def group_medians(values: Float64, groups: Int64, count: int) -> Float64:
    """Compute the median of each group.

    Args:
        values: (m,) values.
        groups: (m,) group of each value, in [0, count).
        count: Number of groups.

    Returns:
        (count,) medians, NaN for empty groups.
    """
    order = np.lexsort((values, groups))
    sizes = np.bincount(groups, minlength=count)
    first = np.cumsum(sizes) - sizes
    medians = np.full(count, np.nan)
    nonempty = sizes > 0
    low, high = first + (sizes - 1) // 2, first + sizes // 2
    ordered = values[order]
    medians[nonempty] = (ordered[low[nonempty]] + ordered[high[nonempty]]) / 2
    return medians
