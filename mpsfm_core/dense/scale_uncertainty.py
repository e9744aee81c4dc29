"""How far the scale of what pairs of views measure may be off, beside that of the others.

Two views tell depth up to the length of their baseline, and agree with each other whatever it is.
Lengths are tied where two pairs have a photo in common: by the pixels that both confirm, and by the
depth that was known of that photo before, which joins what either pair measured of it. Known depth
of one photo is tied to that of all by what it declares. Errors add up along a chain of such ties.
The log scales of pairs, of known maps and of the world are unknowns, a tie says that two are equal,
and the std is that of an unknown beside the mean of all pairs.
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

from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.geometry.statistics import ONE_SIGMA

_LEAST_STD = 1e-6
"""Of a tie: none is better."""
_ALIKE = 0.5
"""Correlation of the scales of known maps of photos that pairs join: network and scene are the same
(with FastDepth 0.1 to 0.7 in rendered_kitchen and the fountain, as their true scales say; ours)."""
_COLUMNS = 256
"""Of an inverse that are held at once."""


class ScaleConstraints(NamedTuple):
    """What one photo says of the pairs that it makes with others.

    ``others`` (k,): those views. ``pixels`` (k,): how many of its pixels each confirms.
    ``shared`` (k, k), symmetric: 1 / variance of the difference of two pairs' log scales, of the
    pixels that both confirm. ``known`` (k,): the same of the known depth and each pair.
    ``known_std``: of the log scale of the known depth.
    """

    others: list[int]
    pixels: Int64
    shared: Float64
    known: Float64
    known_std: float


def measure_scale_constraints(
    differences: Mapping[int, Float32],
    change: Float32,
    known_std: float,
    correlation_px: float,
) -> ScaleConstraints:
    """Compare what the pairs of a photo say of it, all (h, w) of its map.

    Args:
        differences: other view -> what :func:`~mpsfm_core.dense.geometric_consistency.compare_depths`
            says of it.
        change: from the log depth that was known before to the measured one.
        known_std: declared, of that depth.
        correlation_px: distance over which errors hang together, in pixels of the map. So large a
            square is one observation.

    Of k pairs that confirm a pixel each is as sure as the others, and what they have in common, the
    photo's own error, tells nothing. They differ by as much as shared pixels differ in the mean,
    whatever their number. Known depth is as far off in the region of a pair as the distance of
    known and measured depth there: errors of a map hang together over the region.
    """
    confirmed = {other: np.isfinite(map_) for other, map_ in differences.items()}
    others = [other for other, which in confirmed.items() if which.any()]
    off = [np.quantile(np.abs(change[confirmed[each]]), ONE_SIGMA) for each in others]
    known = np.maximum(np.array(off, np.float64), _LEAST_STD) ** -2
    views = np.sum([confirmed[each] for each in others], axis=0)
    shared = np.zeros((len(others), len(others)))
    for a, b in combinations(range(len(others)), 2):
        both = confirmed[others[a]] & confirmed[others[b]]
        patches = np.count_nonzero(both) // correlation_px**2
        if patches:
            between = differences[others[a]][both] - differences[others[b]][both]
            variance = float(between.mean()) ** 2 + float(between.var()) / patches
            share = float(np.mean(2 / views[both]))
            shared[a, b] = shared[b, a] = share / max(variance, _LEAST_STD**2)
    pixels = np.array([np.count_nonzero(confirmed[each]) for each in others], np.int64)
    return ScaleConstraints(others, pixels, shared, known, known_std)


def estimate_scale_stds(photos: Mapping[int, ScaleConstraints]) -> dict[int, float]:
    """Of each photo the std of the log scale of what was measured of it: that of its pairs, each as
    far as it confirms pixels; that of its known depth where none does. 0 if there is no pair.

    ``photos``: by view, whose numbers are those of :attr:`ScaleConstraints.others`.
    """
    numbers: dict[tuple[int, int], int] = {}
    pairs = {
        view: np.array(
            [numbers.setdefault((min(view, j), max(view, j)), len(numbers)) for j in ties.others],
            np.int64,
        )
        for view, ties in photos.items()
    }
    if not numbers:
        return dict.fromkeys(photos, 0.0)
    maps = {view: len(numbers) + row for row, view in enumerate(photos)}
    count = len(numbers) + len(maps)
    rows, columns, values, weight = [], [], [], np.zeros(count)
    for view, ties in photos.items():
        own = pairs[view]
        a, b = np.nonzero(np.triu(ties.shared))
        rows += [own[a], own]
        columns += [own[b], np.full(len(own), maps[view])]
        values += [ties.shared[a, b], ties.known]
        weight[own] += ties.pixels
    one_way = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    half = coo_array(one_way, shape=(count, count)).tocsr()
    to_world = _ties_to_world(
        half, list(maps.values()), [each.known_std for each in photos.values()]
    )
    variance = _variance_beside_mean(csr_array(half + half.T), to_world, weight / weight.sum())
    return {
        view: float(
            np.average(variance[pairs[view]], weights=ties.pixels) ** 0.5
            if ties.others
            else variance[maps[view]] ** 0.5
        )
        for view, ties in photos.items()
    }


def _ties_to_world(precision: csr_array, maps: list[int], stds: list[float]) -> Float64:
    """(n,) 1 / variance of each unknown beside the world, of which only ``maps`` tell.

    ``stds``: of these. Errors of those that ties of this ``precision`` (n, n) join hang together.
    """
    groups = connected_components(precision, directed=False)[1][maps]
    joined = np.bincount(groups)[groups]
    to_world = np.zeros(precision.shape[0])
    to_world[maps] = 1 / ((1 + _ALIKE * (joined - 1)) * np.square(stds))
    return to_world


def _variance_beside_mean(precision: csr_array, to_world: Float64, weight: Float64) -> Float64:
    """Of n unknowns whose differences are known to be 0 with this ``precision`` (n, n), and
    themselves with that ``to_world`` (n,): variance (n,) of each less their mean by ``weight``
    (n,), which sums up to 1."""
    system = diags_array(precision.sum(axis=1) + to_world) - precision
    solve = splu(system.tocsc()).solve
    count = len(weight)
    sums, own = solve(weight), np.zeros(count)
    for start in range(0, count, _COLUMNS):
        width = min(_COLUMNS, count - start)
        columns = solve(np.eye(count, width, -start))
        own[start : start + width] = columns[start : start + width].diagonal()
    variance: Float64 = np.maximum(own - 2 * sums + weight @ sums, 0)
    return variance
