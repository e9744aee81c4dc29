"""Whether views agree on the depth that each of them found by itself."""
# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.dense.dense_view import PosedGrid
from mpsfm_core.geometry.statistics import ONE_SIGMA
from mpsfm_core.support.jit import kernel

_STDS = 3.0
"""Difference of two depths in std that still agree."""
_MIN_TOLERANCE, _MAX_TOLERANCE = 0.005, 0.05
"""Of log depth: poses are not exact, and wide ranges agree with anything (ours)."""
_ALIKE = 0.3
"""Correlation of the errors of maps that agree: with it 72, 76 and 76 % of the measured pixels of
rendered_kitchen `all` (FastDepth, degraded and true depth) are within their std, 75, 79 and 77 % if
the mean of maps were no surer than one of them (ours)."""
_CHANCE = 0.5
"""Share of a pair's agreement above which chance may be all of it (ours)."""
_MIN_FOUND = 0.25
"""Of the patches of such a pair, found in the other photo: in hololens_room 0.2 to 0.8 where the
pose of a pair is right to 5 degrees (but one of hardly any pixels, 0.14), 0 to 0.26 where it is
wrong by more than 30 (ours)."""


@dataclass(frozen=True, eq=False)
class GeometricConsistency:
    """What other views say of a map, (h, w).

    ``views``: uint16, how many agree; one is enough, as two wrong depths rarely do (of those that
    one of three views confirms 95 % are right to 2 % on rendered_kitchen, whatever the others say).
    ``mean_change``: float32, from our log depth to the mean of ours and those that agree.
    ``match_std_px``: std of a match that the differences of depths that agree speak for, NaN
    without any. ``pose_std_px``: what errors of poses add, which no difference shows.
    """

    views: NDArray[np.uint16]
    mean_change: Float32
    match_std_px: float
    pose_std_px: float = 0.0

    @property
    def confirmed(self) -> Bool:
        """(h, w), where a view agrees."""
        return self.views > 0

    @property
    def std_px(self) -> Float32:
        """(h, w), of the mean of a map and those that agree. Errors of maps hang together, which
        makes their differences smaller and their mean less sure."""
        views = self.views.astype(np.float32)
        mean = self.match_std_px**2 * (1 + _ALIKE * views) / ((1 - _ALIKE) * (1 + views))
        std: Float32 = np.sqrt(mean + self.pose_std_px**2).astype(np.float32)
        return std


class PosedDepth(NamedTuple):
    """A map of a view: log depth and its std, (h, w)."""

    grid: PosedGrid
    log_depth: Float32
    log_std: Float32


class DepthDifferences(NamedTuple):
    """From a map to that of another view, (h, w).

    ``log_depth``: float32, at the same points, NaN where they do not agree or the other does not
    see the point. ``beyond``: bool, where they differ by more than agrees, up to twice as much.
    """

    log_depth: Float32
    beyond: Bool

    @property
    def agree(self) -> Bool:
        """(h, w)."""
        return np.isfinite(self.log_depth)

    def where(self, usable: Bool) -> DepthDifferences:
        """Of usable pixels (h, w) alone."""
        return DepthDifferences(
            np.where(usable, self.log_depth, np.float32(np.nan)), self.beyond & usable
        )

    def by_chance(self, patches_found: float) -> bool:
        """Whether the pair may agree by chance, which puts as many depths beyond as it lets agree.

        ``patches_found``: share of the patches that agree, found at about the same place.
        """
        beyond, agree = int(self.beyond.sum()), int(self.agree.sum())
        return beyond > _CHANCE * agree and patches_found < _MIN_FOUND


def compare_depths(own: PosedDepth, other: PosedDepth) -> DepthDifferences:
    """From our log depth to that of another view."""
    differences = np.full(own.log_depth.shape, np.nan, np.float32)
    beyond = np.zeros(differences.shape, np.bool_)
    turned, shift = other.grid.pixels_from(own.grid)
    _compare(*own[1:], turned, shift, *other[1:], differences, beyond)
    return DepthDifferences(differences, beyond)


def evaluate_consistency(
    parallax: Float32, differences: Iterable[Float32], pose_std_px: float = 0.0
) -> GeometricConsistency:
    """What :attr:`DepthDifferences.log_depth` of other views say together of a map (h, w).

    ``parallax``: (h, w), pixels that a point moves when its log depth changes by one. A difference
    has the errors of two matches. ``pose_std_px``: see :class:`GeometricConsistency`.
    """
    views, change, moved = np.zeros(parallax.shape, np.uint16), np.zeros_like(parallax), []
    for each in differences:
        agree = np.isfinite(each)
        views += agree
        change[agree] += each[agree]
        moved.append(np.abs(each[agree]) * parallax[agree])
    all_moved = np.concatenate([np.zeros(0, np.float32), *moved])
    std = float(np.quantile(all_moved, ONE_SIGMA)) / math.sqrt(2) if len(all_moved) else math.nan
    return GeometricConsistency(views, change / (1 + views.astype(np.float32)), std, pose_std_px)


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
    beyond: Bool,
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
            elif abs(difference) <= 2 * tolerance:
                beyond[i, j] = True


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
