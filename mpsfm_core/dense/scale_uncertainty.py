"""Scale uncertainty of stereo depth between image pairs.

The depth of an image pair is known up to the length of its baseline. The log scales of pairs that
share an image are linked by pixels that both pairs confirm, and by the input depth of the image.
The declared std of input depth links the scale of each depth map to the world. The log scales of
pairs, input depth maps and the world form a Gaussian network, in which a constraint limits the
difference of two log scales. The reported std is the marginal std of a scale relative to the mean
of all pairs.
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
"""Minimum std of a log scale constraint; avoids infinite precision."""
_SCALE_CORRELATION = 0.5
"""Correlation of the scale errors of input depth maps in one component.

The scale errors are correlated because one network predicts all depth maps of the scene [ours]."""
_BLOCK_COLUMNS = 256
"""Number of columns of the inverse precision matrix that are solved together; bounds the memory."""


class ScaleConstraints(NamedTuple):
    """Scale constraints that one image measures between its k pairs and its input depth."""

    sources: list[int]
    """(k,) index of the second image of each pair."""
    pixels: Int64
    """(k,) number of pixels whose depth each pair confirms."""
    shared: Float64
    """(k, k) symmetric precision of the log scale difference of two pairs, from shared pixels."""
    known: Float64
    """(k,) precision of the log scale difference between the input depth and each pair."""
    known_std: float
    """Declared std of the input depth map's log scale."""


def measure_scale_constraints(
    differences: Mapping[int, Float32],
    change: Float32,
    known_std: float,
    correlation_px: float,
) -> ScaleConstraints:
    """Measure the scale constraints between an image's pairs and its input depth.

    All pairs that confirm a pixel have equal variance; the depth error that the pairs have in
    common cancels. The squared mean difference of shared pixels is a lower bound of the variance.
    Errors of input depth are correlated within the region of a pair. The std of the input depth is
    therefore its distance to the stereo depth in the region.

    Args:
        differences: Source image -> (h, w) differences from
            :func:`~mpsfm_core.dense.geometric_consistency.compare_depths`.
        change: (h, w) stereo minus input log depth.
        known_std: Declared std of the input log depth.
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

    The scale variance of an image is the mean over its pairs, weighted by the number of confirmed
    pixels. An image without pairs has the scale variance of its input depth. If no image has a
    pair, all stds are 0.

    Args:
        images: Image index -> constraints, with the indices of :attr:`ScaleConstraints.sources`.
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

    The precision of image pairs is 0. Depth maps of one component have correlated scale errors,
    which reduces the precision of each map.

    Args:
        precision: (n, n) precision of the constraints between unknown log scales.
        maps: Indices of the unknowns that are log scales of input depth maps.
        stds: Declared std of each input depth map's log scale.

    Returns:
        (n,) precision relative to the world, 0 for image pairs.
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
