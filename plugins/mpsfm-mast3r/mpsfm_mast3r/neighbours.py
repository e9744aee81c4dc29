"""Reciprocal nearest neighbours of unit descriptors."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float32, Int64

_BLOCK = 1 << 24
"""Similarities computed at once: 64 MB."""
_ROUNDS = 10
"""As in MASt3R; nearly all searches end after three."""


def nearest(queries: Float32, base: Float32) -> Int64:
    """Row of ``base`` (m, d) with the largest dot product, for each query (n, d)."""
    step = max(1, _BLOCK // max(len(base), 1))
    blocks = [
        (queries[start : start + step] @ base.T).argmax(axis=1)
        for start in range(0, len(queries), step)
    ]
    return np.concatenate([np.empty(0, dtype=np.int64), *blocks])


def reciprocal(a: Float32, b: Float32, start: Int64) -> Int64:
    """Pairs (m, 2) of rows that are each other's nearest, found from rows ``start`` of ``a``.

    From a row to its nearest, back to the nearest of that, and on until it stays (Leroy et al.,
    ECCV 2024, fast reciprocal matching).
    """
    found = [np.empty((0, 2), dtype=np.int64)]
    current = start
    for _ in range(_ROUNDS):
        there = nearest(a[current], b)
        back = nearest(b[there], a)
        settled = back == current
        found.append(np.stack([current[settled], there[settled]], axis=1))
        current = np.unique(back[~settled])
        if not len(current):
            break
    return np.unique(np.concatenate(found), axis=0)


def mutual(similarity: Float32) -> Int64:
    """Pairs (m, 2) of a row and a column of a matrix that are each other's largest entry."""
    if not similarity.size:
        return np.empty((0, 2), dtype=np.int64)
    there, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    return np.stack([rows, there[rows]], axis=1)
