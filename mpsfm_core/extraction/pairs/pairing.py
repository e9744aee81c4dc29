"""Which pairs of images are matched."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.extraction.options import PairOptions

Pair = tuple[int, int]
"""Positions of two images, the smaller first."""

_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")
_ABOVE_NOTHING = float(np.finfo(np.float64).tiny)


def exhaustive_pairs(count: int) -> list[Pair]:
    """All pairs of ``count`` images."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def sequential_pairs(count: int, options: PairOptions) -> list[Pair]:
    """Each image with the next ones, or with those 1, 2, 4, 8, ... further on."""
    steps = range(options.overlap)
    offsets = [2**step if options.quadratic else step + 1 for step in steps]
    return _unordered((a, a + d) for a in range(count) for d in offsets if a + d < count)


def retrieval_pairs(descriptors: Sequence[Float32], options: PairOptions) -> list[Pair]:
    """Each image with its most similar ones; descriptors (d,) are compared by dot product."""
    matrix = np.stack(descriptors).astype(np.float64)
    least = max(options.min_similarity, -np.finfo(np.float64).max)
    return most_similar_pairs(matrix @ matrix.T, options.top_k, least)


def most_similar_pairs(
    likeness: Float64,
    count: int,
    least: float = _ABOVE_NOTHING,
    images: Iterable[int] | None = None,
) -> list[Pair]:
    """Each of the ``images``, all if None, with the ``count`` others it is most like; ``likeness``
    (n, n), those of a smaller one than ``least`` are left out."""
    others = likeness.copy()
    np.fill_diagonal(others, -np.inf)
    best = np.argsort(-others, axis=1, kind="stable")[:, :count]
    chosen = range(len(others)) if images is None else images
    return _unordered((a, int(b)) for a in chosen for b in best[a] if others[a, b] >= least)


def numbered_neighbor_pairs(names: Sequence[str], options: PairOptions) -> list[Pair]:
    """Each image with the next ones in its sequence; images belong to one when their names differ
    by the last number in them only, and follow each other by that number."""
    sequences: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for index, name in enumerate(names):
        found = _NUMBERED.fullmatch(name)
        if found is not None:
            before, number, after = found.groups()
            sequences.setdefault((before, after), []).append((int(number), index))
    return _unordered(
        (sequence[a][1], sequence[b][1])
        for sequence in map(sorted, sequences.values())
        for a, b in sequential_pairs(len(sequence), options)
    )


def filter_pairs(
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
