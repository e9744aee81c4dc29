"""Robust statistics, and groups of equal rows."""

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


def unique_rows(rows: Int64) -> tuple[Int64, Int64]:
    """Find the distinct rows of an integer array, ten times as fast as ``np.unique(axis=0)``.

    Args:
        rows: (n, c) integers.

    Returns:
        Index (k,) of the first of equal rows, in the lexicographic order of the distinct rows, and
        the number (n,) of each row's distinct row.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_first = np.ones(len(rows), np.bool_)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    numbers = np.empty(len(rows), np.int64)
    numbers[order] = np.cumsum(is_first) - 1
    return order[is_first], numbers
