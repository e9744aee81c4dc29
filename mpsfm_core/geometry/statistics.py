"""Robust statistics."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, Int64

MAD_TO_STD = 1.4826
"""Of normal errors: from the median of their absolute values to their std."""
ONE_SIGMA = 0.683
"""Share within one std of a normal distribution."""


def weighted_quantile(values: Float64, weights: Float64, share: float) -> float:
    """The value below which this share of the weight lies; both (n,)."""
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    place = int(np.searchsorted(cumulated, share * cumulated[-1]))
    return float(values[order[min(place, len(order) - 1)]])


def group_medians(values: Float64, groups: Int64, count: int) -> Float64:
    """(count,) median of the values (m,) of each group; NaN for those without any.

    ``groups``: (m,) int, the group of each, in [0, count).
    """
    order = np.lexsort((values, groups))
    sizes = np.bincount(groups, minlength=count)
    first = np.cumsum(sizes) - sizes
    medians = np.full(count, np.nan)
    some = sizes > 0
    low, high = first + (sizes - 1) // 2, first + sizes // 2
    ordered = values[order]
    medians[some] = (ordered[low[some]] + ordered[high[some]]) / 2
    return medians
