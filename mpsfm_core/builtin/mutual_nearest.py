"""Matching by mutual nearest neighbours of descriptors."""

from __future__ import annotations

import numpy as np

from mpsfm_core.builtin.options import MutualNearestOptions
from mpsfm_core.data import Features, Float32, Int64, PairMatches, SparseMatches, View
from mpsfm_core.errors import ProviderError
from mpsfm_core.providers import ProviderContext, required_features

_BLOCK = 1024
"""Rows compared at once: 32 MB for 8192 features on the other side."""
_ROUNDING = np.float32(1e-5)
"""Squared distances that differ by less than this share of the descriptors' squared length count
as equal: they are differences of squares in float32, a hundred times as exact, and the order of
their sums depends on the processor."""


class MutualNearest:
    """For descriptors of any kind; compares them by Euclidean distance.

    A match's score is ``1 - nearest / second nearest distance`` (the larger ratio of the two
    directions), a measure of how distinct it is.
    """

    def __init__(self, options: MutualNearestOptions, context: ProviderContext) -> None:
        self._options = options

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Sparse matches, each feature in at most one."""
        features_a, features_b = required_features(
            "mutual-nearest matches features", features_a, features_b
        )
        a, b = features_a.descriptors, features_b.descriptors
        if a.shape[1] != b.shape[1] and len(a) and len(b):
            raise ProviderError(
                f"descriptors of {view_a.name!r} and {view_b.name!r} differ in dimension"
            )
        pairs, nearest, ratio = _mutual(a, b)
        keep = ratio <= (1.0 if self._options.ratio is None else self._options.ratio)
        if self._options.max_distance is not None:
            keep &= nearest <= self._options.max_distance
        scores = np.clip(1 - ratio, 0, 1).astype(np.float32)
        return PairMatches(sparse=SparseMatches(pairs[keep], scores[keep]))


def _mutual(a: Float32, b: Float32) -> tuple[Int64, Float32, Float32]:
    """Mutual nearest neighbours (m, 2), their distances (m,), and the larger of the ratios to the
    second nearest in both directions (m,)."""
    if not (len(a) and len(b)):
        empty = np.empty(0, dtype=np.float32)
        return np.empty((0, 2), dtype=np.int64), empty, empty
    best, nearest, second = _nearest_two(a, b)
    lowest = np.full(len(b), np.inf, dtype=np.float32)
    np.minimum.at(lowest, best, nearest)
    rows = np.flatnonzero(nearest == lowest[best])
    rows = rows[np.unique(best[rows], return_index=True)[1]]  # equal distances: the first one
    back, _, second_back = _nearest_two(b[best[rows]], a)
    mutual = back == rows
    rows = rows[mutual]
    pairs = np.stack([rows, best[rows]], axis=1)
    limit = np.minimum(second[rows], second_back[mutual])
    rounding = _ROUNDING * np.einsum("ij,ij->i", a[rows], a[rows])  # equal ones have a ratio of 1
    ratio = np.sqrt((nearest[rows] + rounding) / (limit + rounding))
    return pairs, np.sqrt(nearest[rows]), ratio


def _nearest_two(a: Float32, b: Float32) -> tuple[Int64, Float32, Float32]:
    """For each row of ``a`` its nearest row of ``b``, and the squared distances of the nearest and
    the second nearest (infinite where there is none)."""
    best = np.empty(len(a), dtype=np.int64)
    nearest = np.empty(len(a), dtype=np.float32)
    second = np.empty(len(a), dtype=np.float32)
    transposed = -2.0 * b.T
    norms_b = np.einsum("ij,ij->i", b, b)
    for start in range(0, len(a), _BLOCK):
        rows = slice(start, min(start + _BLOCK, len(a)))
        # Without the norm of a, which is the same along a row.
        distances = a[rows] @ transposed
        distances += norms_b
        index = np.arange(len(distances))
        best[rows] = distances.argmin(axis=1)
        nearest[rows] = distances[index, best[rows]]
        distances[index, best[rows]] = np.inf
        second[rows] = distances.min(axis=1)
    norms_a = np.einsum("ij,ij->i", a, a)
    return best, np.maximum(nearest + norms_a, 0), np.maximum(second + norms_a, 0)
