"""Reciprocal nearest-neighbor search among unit descriptors."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float32, Int64

_BLOCK = 1 << 24
"""Number of descriptor similarities in one matrix product, which take 64 MB."""
_ROUNDS = 10
"""Maximum number of iterations of the reciprocal search [MASt3R]. Nearly all searches converge in
three iterations."""


def find_nearest(queries: Float32, base: Float32) -> Int64:
    """Find the index (n,) of the most similar descriptor in ``base`` for each query (n, d)."""
    step = max(1, _BLOCK // max(len(base), 1))
    blocks = [
        (queries[start : start + step] @ base.T).argmax(axis=1)
        for start in range(0, len(queries), step)
    ]
    return np.concatenate([np.empty(0, dtype=np.int64), *blocks])


def find_reciprocal(a: Float32, b: Float32, start: Int64) -> Int64:
    """Find index pairs (m, 2) of mutual nearest neighbors, starting at the rows ``start`` of a.

    The search iterates from a descriptor to its nearest neighbor and back until the pair is stable
    (fast reciprocal matching, Leroy et al., ECCV 2024).
    """
    pairs = [np.empty((0, 2), dtype=np.int64)]
    current = start
    for _ in range(_ROUNDS):
        there = find_nearest(a[current], b)
        back = find_nearest(b[there], a)
        settled = back == current
        pairs.append(np.stack([current[settled], there[settled]], axis=1))
        current = np.unique(back[~settled])
        if not len(current):
            break
    return np.unique(np.concatenate(pairs), axis=0)


def find_mutual(similarity: Float32) -> Int64:
    """Find matrix entries (m, 2) that are the largest of both their row and their column."""
    if not similarity.size:
        return np.empty((0, 2), dtype=np.int64)
    there, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    return np.stack([rows, there[rows]], axis=1)
