"""How far the scale of what pairs of views measure may be off, beside that of the other pairs.

Two views tell depth up to the length of their baseline, and agree with each other whatever it is.
Lengths are tied where two pairs have a photo in common: by the pixels that both confirm, and by the
depth that was known of that photo before, which joins what either pair measured of it. Along a
chain of such ties errors add up. The log scale of each pair is an unknown, a tie says that two are
equal, and the std is that of an unknown beside the mean of all.
Where the mapper had no depth, something else holds the scales, of which a model says nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float32, Float64, Int64
from mpsfm_core.dense.posterior import MIN_STD
from mpsfm_core.statistics import ONE_SIGMA

_COLUMNS = 256
"""Of an inverse that are held at once."""


class Ties(NamedTuple):
    """What one photo says of the pairs that it makes with others.

    ``others`` (k,): those views. ``pixels`` (k,): how many of its pixels each confirms.
    ``precision`` (k, k), symmetric: 1 / variance of the difference of two pairs' log scales.
    """

    others: list[int]
    pixels: Int64
    precision: Float64


def ties_of_photo(
    differences: Mapping[int, Float32], usable: Bool, change: Float32, correlation_px: float
) -> Ties:
    """Compare what the pairs of a photo say of it, all (h, w) of its map.

    Args:
        differences: other view -> what :func:`~mpsfm_core.dense.consistency.depth_differences`
            says of it.
        usable: pixels that count.
        change: from the log depth that was known before to the measured one.
        correlation_px: distance over which errors hang together, in pixels of the map. So large a
            square is one observation.

    The known depth ties two pairs with an error that is in each of the two regions as large as the
    distance of known and measured depth there: errors of a map hang together over the region.
    """
    confirmed = {other: np.isfinite(map_) & usable for other, map_ in differences.items()}
    others = [other for other, which in confirmed.items() if which.any()]
    square = [np.quantile(np.abs(change[confirmed[each]]), ONE_SIGMA) ** 2 for each in others]
    precision = np.zeros((len(others), len(others)))
    for a, b in combinations(range(len(others)), 2):
        both = confirmed[others[a]] & confirmed[others[b]]
        found = 1 / max(square[a] + square[b], MIN_STD**2)
        patches = np.count_nonzero(both) // correlation_px**2
        if patches:
            between = differences[others[a]][both] - differences[others[b]][both]
            found += patches / max(float(np.mean(between**2)), MIN_STD**2)
        precision[a, b] = precision[b, a] = found
    pixels = np.array([np.count_nonzero(confirmed[each]) for each in others], np.int64)
    return Ties(others, pixels, precision)


def scale_stds(photos: Mapping[int, Ties]) -> dict[int, float]:
    """Of each photo the std of the log scale of what was measured of it: that of its pairs, each as
    far as it confirms pixels; 0 where none does.

    ``photos``: by view, whose numbers are those of :attr:`Ties.others`.
    """
    numbers: dict[tuple[int, int], int] = {}
    pairs = {
        view: [numbers.setdefault((min(view, j), max(view, j)), len(numbers)) for j in ties.others]
        for view, ties in photos.items()
    }
    parts = [
        (np.repeat(pairs[view], len(pairs[view])), np.tile(pairs[view], len(pairs[view])), ties)
        for view, ties in photos.items()
        if ties.others
    ]
    if not parts:
        return dict.fromkeys(photos, 0.0)
    rows, columns = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    values = np.concatenate([part[2].precision.ravel() for part in parts])
    shape = len(numbers), len(numbers)
    variance = _variance_beside_mean(coo_array((values, (rows, columns)), shape=shape).tocsr())
    return {
        view: float(np.average(variance[pairs[view]], weights=ties.pixels) ** 0.5)
        if ties.others
        else 0.0
        for view, ties in photos.items()
    }


def _variance_beside_mean(precision: csr_array) -> Float64:
    """Of n unknowns whose differences are known to be 0 with this ``precision`` (n, n): variance
    (n,) of each less the mean of those that it is connected with."""
    laplacian = csr_array(diags_array(precision.sum(axis=1)) - precision)
    variance = np.zeros(precision.shape[0])
    groups = connected_components(precision, directed=False)[1]
    for group in range(groups.max() + 1):
        members = np.flatnonzero(groups == group)
        free = members[1:]  # beside the first one, whose row and column of the inverse are 0
        if not len(free):
            continue
        solve = splu(laplacian[free][:, free].tocsc()).solve
        own, sums = np.zeros(len(members)), np.zeros(len(members))
        for start in range(0, len(free), _COLUMNS):
            count = min(_COLUMNS, len(free) - start)
            columns = solve(np.eye(len(free), count, -start))
            own[1 + start : 1 + start + count] = columns[start : start + count].diagonal()
            sums[1 + start : 1 + start + count] = columns.sum(axis=0)
        mean = sums.sum() / len(members) ** 2
        variance[members] = np.maximum(own - 2 * sums / len(members) + mean, 0)
    return variance
