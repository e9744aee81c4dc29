"""Scale uncertainty of stereo depth between image pairs.

The depth of an image pair is known up to the length of its baseline. The log scales of pairs that
share an image are linked by pixels that both pairs confirm, and by the input depth of the image.
The std of input depth limits the log scale of each depth map relative to the world. The log scales
of pairs, input depth maps and the world form a Gaussian network, in which a constraint limits the
difference of two log scales. The estimated scale std is the marginal std of a log scale relative to
the mean over all image pairs.
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

_MIN_CONSTRAINT_STD = 1e-6
"""Minimum std of a constraint between two log scales, which avoids infinite precision."""
_SCALE_CORRELATION = 0.5
"""Correlation of the scale errors of input depth maps in one component.

Scale errors are correlated because one network predicts all depth maps of the scene [ours]."""
_BLOCK_COLUMNS = 256
"""Number of columns of the covariance matrix that are computed together; bounds the memory."""


class ScaleConstraints(NamedTuple):
    """Constraints between the depth scales of an image's k stereo pairs and its input depth."""

    sources: list[int]
    """(k,) index of the second image of each stereo pair."""
    pixels: Int64
    """(k,) number of pixels of the image whose depth each stereo pair confirms."""
    shared: Float64
    """(k, k) precision of the log scale difference of two stereo pairs, from pixels confirmed by
    both."""
    known: Float64
    """(k,) precision of the log scale difference between the input depth and each stereo pair."""
    known_std: float
    """Prior std of the input depth map's log scale."""


def measure_scale_constraints(
    differences: Mapping[int, Float32],
    change: Float32,
    known_std: float,
    correlation_px: float,
) -> ScaleConstraints:
    """Measure constraints between the depth scales of an image's stereo pairs and input depth.

    All stereo pairs that confirm a pixel are assumed to have equal depth variance. The variance of
    a scale difference is at least the squared mean log depth difference at the pixels that both
    pairs confirm. Errors of input depth are correlated within the pixels that a stereo pair
    confirms. The std of input depth is therefore the distance between input and stereo depth at the
    pixels that a stereo pair confirms.

    Args:
        differences: Source image -> (h, w) log depth differences from
            :func:`~mpsfm_core.dense.geometric_consistency.compare_depths`.
        change: (h, w) log of stereo depth minus log of input depth.
        known_std: Prior std of the log of input depth.
        correlation_px: Correlation length of depth errors in pixels; a square of this side counts
            as one observation.
    """
    confirmed = {source: np.isfinite(map_) for source, map_ in differences.items()}
    sources = [source for source, mask in confirmed.items() if mask.any()]
    known_errors = [np.quantile(np.abs(change[confirmed[j]]), ONE_SIGMA) for j in sources]
    known = np.maximum(np.array(known_errors, np.float64), _MIN_CONSTRAINT_STD) ** -2
    num_views = np.sum([confirmed[j] for j in sources], axis=0)
    shared = np.zeros((len(sources), len(sources)))
    for a, b in combinations(range(len(sources)), 2):
        both = confirmed[sources[a]] & confirmed[sources[b]]
        observations = np.count_nonzero(both) // correlation_px**2
        if observations:
            difference = differences[sources[a]][both] - differences[sources[b]][both]
            variance = float(difference.mean()) ** 2 + float(difference.var()) / observations
            weight = float(np.mean(2 / num_views[both]))
            shared[a, b] = shared[b, a] = weight / max(variance, _MIN_CONSTRAINT_STD**2)
    pixels = np.array([np.count_nonzero(confirmed[j]) for j in sources], np.int64)
    return ScaleConstraints(sources, pixels, shared, known, known_std)


def estimate_scale_stds(images: Mapping[int, ScaleConstraints]) -> dict[int, float]:
    """Estimate the std of the log scale of each image's stereo depth.

    The scale variance of an image is the mean over its stereo pairs, weighted by their numbers of
    confirmed pixels. An image without stereo pairs has the scale variance of its input depth. If no
    image has a stereo pair, all scale stds are 0.

    Args:
        images: Image index -> scale constraints of the image.
    """
    pair_ids: dict[tuple[int, int], int] = {}
    pairs = {
        i: np.array(
            [pair_ids.setdefault((min(i, j), max(i, j)), len(pair_ids)) for j in each.sources],
            np.int64,
        )
        for i, each in images.items()
    }
    if not pair_ids:
        return dict.fromkeys(images, 0.0)
    map_ids = {i: len(pair_ids) + row for row, i in enumerate(images)}
    count = len(pair_ids) + len(map_ids)
    rows, columns, values, weight = [], [], [], np.zeros(count)
    for i, constraints in images.items():
        a, b = np.nonzero(np.triu(constraints.shared))
        rows += [pairs[i][a], pairs[i]]
        columns += [pairs[i][b], np.full(len(pairs[i]), map_ids[i])]
        values += [constraints.shared[a, b], constraints.known]
        weight[pairs[i]] += constraints.pixels
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    upper = coo_array(entries, shape=(count, count)).tocsr()
    world_precision = _world_precision(
        upper, list(map_ids.values()), [each.known_std for each in images.values()]
    )
    variance = _variance_relative_to_mean(
        csr_array(upper + upper.T), world_precision, weight / weight.sum()
    )
    return {
        i: float(
            np.average(variance[pairs[i]], weights=constraints.pixels) ** 0.5
            if constraints.sources
            else variance[map_ids[i]] ** 0.5
        )
        for i, constraints in images.items()
    }


def _world_precision(precision: csr_array, maps: list[int], stds: list[float]) -> Float64:
    """Compute the precision of each unknown log scale relative to the world.

    The log scales of stereo pairs have no constraint to the world, so their precision is 0. Depth
    maps of one component have correlated scale errors, which reduces the precision of each map.

    Args:
        precision: (n, n) precision of the constraints between unknown log scales.
        maps: Indices of the unknown log scales that belong to input depth maps.
        stds: Prior std of each input depth map's log scale.

    Returns:
        (n,) precision of each log scale relative to the world, 0 for stereo pairs.
    """
    components = connected_components(precision, directed=False)[1][maps]
    component_sizes = np.bincount(components)[components]
    world = np.zeros(precision.shape[0])
    world[maps] = 1 / ((1 + _SCALE_CORRELATION * (component_sizes - 1)) * np.square(stds))
    return world


def _variance_relative_to_mean(
    precision: csr_array, world_precision: Float64, weight: Float64
) -> Float64:
    """Compute the variance of each log scale relative to the weighted mean of all log scales.

    Args:
        precision: (n, n) precision of the differences of log scales.
        world_precision: (n,) precision of each log scale relative to the world.
        weight: (n,) weights of the mean log scale, with sum 1.
    """
    system = diags_array(precision.sum(axis=1) + world_precision) - precision
    solve = splu(system.tocsc()).solve
    count = len(weight)
    covariance_with_mean, diagonal = solve(weight), np.zeros(count)
    for start in range(0, count, _BLOCK_COLUMNS):
        width = min(_BLOCK_COLUMNS, count - start)
        columns = solve(np.eye(count, width, -start))
        diagonal[start : start + width] = columns[start : start + width].diagonal()
    variance: Float64 = np.maximum(
        diagonal - 2 * covariance_with_mean + weight @ covariance_with_mean, 0
    )
    return variance
