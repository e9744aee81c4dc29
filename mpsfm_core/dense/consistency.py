"""Whether views agree on the depth that each of them found by itself."""
# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.dense.view import PosedGrid
from mpsfm_core.jit import kernel
from mpsfm_core.statistics import ONE_SIGMA

_STDS = 3.0
"""Difference of two depths in std that still agree."""
_MIN_TOLERANCE, _MAX_TOLERANCE = 0.005, 0.05
"""Of log depth: poses are not exact, and wide ranges agree with anything (ours)."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What other views say of a map, (h, w).

    ``confirmed``: bool, where a view agrees: two wrong depths rarely do (of those that one of three
    views confirms 95 % are right to 2 % on rendered_kitchen, whatever the others say).
    ``mean_change``: float32, from our log depth to the mean of ours and those that agree.
    ``match_std_px``: std of a match that the differences of depths that agree speak for, NaN
    without any. Errors of poses are in it as far as views differ by them.
    """

    confirmed: Bool
    mean_change: Float32
    match_std_px: float


class PosedDepth(NamedTuple):
    """A map of a view: log depth and its std, (h, w)."""

    grid: PosedGrid
    log_depth: Float32
    log_std: Float32


def depth_differences(own: PosedDepth, other: PosedDepth) -> Float32:
    """From our log depth (h, w) to that of another view at the same points, NaN where they do not
    agree or it does not see the point."""
    differences = np.full(own.log_depth.shape, np.nan, np.float32)
    turned, shift = other.grid.pixels_from(own.grid)
    _compare(*own[1:], turned, shift, *other[1:], differences)
    return differences


def agreement_of(parallax: Float32, differences: Iterable[Float32]) -> Agreement:
    """What :func:`depth_differences` of other views say together of a map (h, w).

    ``parallax``: (h, w), pixels that a point moves when its log depth changes by one. A difference
    has the errors of two matches.
    """
    views, change, moved = np.zeros_like(parallax), np.zeros_like(parallax), []
    for each in differences:
        agree = np.isfinite(each)
        views += agree
        change[agree] += each[agree]
        moved.append(np.abs(each[agree]) * parallax[agree])
    all_moved = np.concatenate([np.zeros(0, np.float32), *moved])
    std = float(np.quantile(all_moved, ONE_SIGMA)) / math.sqrt(2) if len(all_moved) else math.nan
    return Agreement(views > 0, change / (1 + views), std)


def splat_depth(grid: PosedGrid, others: Iterable[tuple[PosedGrid, Float32, Bool]]) -> Float32:
    """Log depth (h, w) that the given pixels of other views have in this one: the nearest at each
    pixel, infinite where there is none."""
    seen = np.full(grid.shape, np.inf, np.float32)
    for other, depth, which in others:
        turned, shift = grid.pixels_from(other)
        _splat(depth, which, turned, shift, seen)
    return seen


@kernel()
def _compare(
    log_depth: Float32,
    log_std: Float32,
    turned: Float64,
    shift: Float64,
    other: Float32,
    other_std: Float32,
    differences: Float32,
) -> None:
    height, width = log_depth.shape
    rows, columns = other.shape
    for i in range(height):
        for j in range(width):
            x, y = j + 0.5, i + 0.5
            depth = math.exp(log_depth[i, j])
            w = depth * (turned[2, 0] * x + turned[2, 1] * y + turned[2, 2]) + shift[2]
            if w <= 1e-6:
                continue
            u = (depth * (turned[0, 0] * x + turned[0, 1] * y + turned[0, 2]) + shift[0]) / w
            v = (depth * (turned[1, 0] * x + turned[1, 1] * y + turned[1, 2]) + shift[1]) / w
            if u < 0 or v < 0 or u >= columns or v >= rows:
                continue
            r, c = int(v), int(u)
            variance = log_std[i, j] ** 2 + other_std[r, c] ** 2
            tolerance = min(max(_STDS * math.sqrt(variance), _MIN_TOLERANCE), _MAX_TOLERANCE)
            difference = other[r, c] - math.log(w)
            if abs(difference) <= tolerance:
                differences[i, j] = difference


@kernel()
def _splat(depth: Float32, which: Bool, turned: Float64, shift: Float64, seen: Float32) -> None:
    height, width = depth.shape
    rows, columns = seen.shape
    for i in range(height):
        for j in range(width):
            if not which[i, j]:
                continue
            x, y, d = j + 0.5, i + 0.5, math.exp(depth[i, j])
            w = d * (turned[2, 0] * x + turned[2, 1] * y + turned[2, 2]) + shift[2]
            if w <= 1e-6:
                continue
            u = (d * (turned[0, 0] * x + turned[0, 1] * y + turned[0, 2]) + shift[0]) / w
            v = (d * (turned[1, 0] * x + turned[1, 1] * y + turned[1, 2]) + shift[1]) / w
            if u >= 0 and v >= 0 and u < columns and v < rows:
                r, c = int(v), int(u)
                seen[r, c] = min(seen[r, c], np.float32(math.log(w)))
