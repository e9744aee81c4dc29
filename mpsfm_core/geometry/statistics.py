"""Robust statistics."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, Int64

MAD_TO_STD = 1.4826
"""Ratio of std to median absolute value of a normal distribution with zero mean."""
ONE_SIGMA = 0.683
"""Probability that a normally distributed error is within one std."""


def weighted_quantile(values: Float64, weights: Float64, ratio: float) -> float:
    """Compute a weighted quantile of values (n,) with weights (n,)."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    position = int(np.searchsorted(cumulative, ratio * cumulative[-1]))
    return float(values[order[min(position, len(order) - 1)]])


def group_medians(values: Float64, groups: Int64, count: int) -> Float64:
    """Compute the median of the values in each group.

    Args:
        values: (m,) values.
        groups: (m,) index of the group that contains each value, in [0, count).
        count: Number of groups.

    Returns:
        (count,) medians of the groups, NaN for empty groups.
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
