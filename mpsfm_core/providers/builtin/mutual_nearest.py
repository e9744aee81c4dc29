"""Brute-force matching of mutual nearest descriptors."""

# mypy: allow-untyped-decorators

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Features, Float32, Int64, PairMatches, SparseMatches, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import ProviderContext, require_features
from mpsfm_core.providers.builtin.options import MutualNearestOptions
from mpsfm_core.support.jit import kernel

_BLOCK = 128
"""Number of rows of the descriptor distance matrix that are computed together. For 8192 descriptors
in the second image, 128 rows are 4 MB, which fits into CPU caches."""
_ROUNDING = np.float32(1e-5)
"""Largest rounding error of a squared descriptor distance, relative to the squared descriptor
length. Squared distances that differ by less than the rounding error count as equal, because the
summation order of float32 depends on the processor."""


class MutualNearest:
    """Matcher of mutual nearest descriptors in Euclidean distance, for any local features.

    The score of a match is ``1 - ratio``. ``ratio`` is the distance to the nearest descriptor
    divided by the distance to the second nearest. The score uses the larger one of the ratios from
    the first to the second image and back.
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
        """Match the features of two views one to one.

        Args:
            view_a: First undistorted image, whose name appears in error messages.
            view_b: Second undistorted image, whose name appears in error messages.
            features_a: Features of the first image, with descriptors.
            features_b: Features of the second image, with descriptors.

        Returns:
            Matches as pairs of keypoint indices with scores.

        Raises:
            ProviderError: The features of an image are missing, or the descriptors of the two
                images differ in dimension.
        """
        features_a, features_b = require_features(
            "mutual-nearest matches features", features_a, features_b
        )
        a, b = features_a.descriptors, features_b.descriptors
        if a.shape[1] != b.shape[1] and len(a) and len(b):
            raise ProviderError(
                f"descriptors of {view_a.name!r} and {view_b.name!r} differ in dimension"
            )
        pairs, nearest, ratio = mutual_nearest(a, b)
        keep = ratio <= (1.0 if self._options.ratio is None else self._options.ratio)
        if self._options.max_distance is not None:
            keep &= nearest <= self._options.max_distance
        scores = np.clip(1 - ratio, 0, 1).astype(np.float32)
        return PairMatches(sparse=SparseMatches(pairs[keep], scores[keep]))


def mutual_nearest(a: Float32, b: Float32) -> tuple[Int64, Float32, Float32]:
    """Find the mutual nearest neighbors of two descriptor sets.

    Args:
        a: Descriptors (n, d) of the first image.
        b: Descriptors (m, d) of the second image.

    Returns:
        Row indices (k, 2) of matching descriptors in ``a`` and ``b``, their distances (k,), and the
        ratio (k,) of nearest to second nearest distance. Each ratio is the larger one of the ratios
        from the first to the second image and back.
    """
    if not (len(a) and len(b)):
        empty = np.empty(0, dtype=np.float32)
        return np.empty((0, 2), dtype=np.int64), empty, empty
    from_a, from_b = _Nearest.initialize(len(a)), _Nearest.initialize(len(b))
    transposed = np.ascontiguousarray(np.float32(-2) * b.T)
    norms_a, norms_b = (np.einsum("ij,ij->i", each, each) for each in (a, b))
    for start in range(0, len(a), _BLOCK):
        rows = slice(start, start + _BLOCK)
        products = a[rows] @ transposed
        _compare(products, start, norms_a[rows], norms_b, *from_a.select(rows), *from_b)
    rows_of_b = np.flatnonzero(from_a.best[from_b.best] == np.arange(len(b)))
    pairs = np.stack([from_b.best[rows_of_b], rows_of_b], axis=1)
    in_a, in_b = pairs.T
    nearest = np.maximum(from_a.nearest[in_a], 0)
    limit = np.maximum(np.minimum(from_a.second[in_a], from_b.second[in_b]), 0)
    # Adding the rounding error to both squared distances makes the ratio of equal distances 1.
    rounding = _ROUNDING * norms_a[in_a]
    ratio = np.sqrt((nearest + rounding) / (limit + rounding))
    return pairs, np.sqrt(nearest), ratio


class _Nearest(NamedTuple):
    """Nearest descriptor in the other image and the two smallest distances, per descriptor."""

    best: Int64
    nearest: Float32
    second: Float32

    @classmethod
    def initialize(cls, count: int) -> _Nearest:
        far = np.full(count, np.inf, np.float32)
        return cls(np.zeros(count, np.int64), far, far.copy())

    def select(self, rows: slice) -> _Nearest:
        """Return numpy views of the nearest-neighbor arrays for a range of descriptors."""
        return _Nearest(self.best[rows], self.nearest[rows], self.second[rows])


@kernel()
def _compare(
    products: Float32,
    start: int,
    norms_a: Float32,
    norms_b: Float32,
    best_of_a: Int64,
    nearest_of_a: Float32,
    second_of_a: Float32,
    best_of_b: Int64,
    nearest_of_b: Float32,
    second_of_b: Float32,
) -> None:
    """Update the nearest neighbors with the products ``-2 a b`` of a block of descriptors."""
    for i in range(len(norms_a)):
        best, nearest, second = 0, np.float32(np.inf), np.float32(np.inf)
        for j in range(len(norms_b)):
            distance = products[i, j] + norms_a[i] + norms_b[j]
            if distance < second:
                if distance < nearest:
                    best, nearest, second = j, distance, nearest
                else:
                    second = distance
            if distance < second_of_b[j]:
                if distance < nearest_of_b[j]:
                    second_of_b[j] = nearest_of_b[j]
                    best_of_b[j], nearest_of_b[j] = start + i, distance
                else:
                    second_of_b[j] = distance
        best_of_a[i], nearest_of_a[i], second_of_a[i] = best, nearest, second
