"""Which pairs of images are matched."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float32
from mpsfm_core.extraction.options import PairOptions

Pair = tuple[int, int]
"""Positions of two images, the smaller first."""


def exhaustive(count: int) -> list[Pair]:
    """All pairs of ``count`` images."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def sequential(count: int, options: PairOptions) -> list[Pair]:
    """Each image with the next ones, or with those 1, 2, 4, 8, ... further on."""
    steps = range(options.overlap)
    offsets = [2**step if options.quadratic else step + 1 for step in steps]
    return _unordered((a, a + d) for a in range(count) for d in offsets if a + d < count)


def retrieval(descriptors: Sequence[Float32], options: PairOptions) -> list[Pair]:
    """Each image with its most similar ones; descriptors (d,) are compared by dot product."""
    matrix = np.stack(descriptors).astype(np.float64)
    similarity: NDArray[np.float64] = matrix @ matrix.T
    np.fill_diagonal(similarity, -np.inf)
    best = np.argsort(-similarity, axis=1, kind="stable")[:, : options.top_k]
    return _unordered(
        (a, int(b))
        for a, row in enumerate(best)
        for b in row
        if similarity[a, b] >= max(options.min_similarity, -np.finfo(np.float64).max)
    )


def apply_filters(
    pairs: Sequence[Pair], names: Sequence[str], answers: Iterable[Iterable[tuple[str, str]]]
) -> list[Pair]:
    """The pairs that every filter's answer (pairs of image names, in any order) contains."""
    kept = [frozenset(frozenset(pair) for pair in answer) for answer in answers]
    return [
        (a, b)
        for a, b in pairs
        if all(frozenset((names[a], names[b])) in answer for answer in kept)
    ]


def _unordered(pairs: Iterable[Pair]) -> list[Pair]:
    return sorted({(min(pair), max(pair)) for pair in pairs})
