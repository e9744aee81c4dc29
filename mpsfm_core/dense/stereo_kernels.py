"""Compiled loops of multi-view matching: warps along a surface, correlation, aggregation.

Images and maps are float32 grids of one size, labels are offsets of log depth from a base surface.
"""
# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from mpsfm_core.data import Float32, Float64, UInt8
from mpsfm_core.support.jit import kernel

_FASTMATH = {"contract", "reassoc", "arcp"}
"""Sums in any order; NaN and infinity keep their meaning."""

UNSEEN = 255
"""Cost of a label at which a view does not see the pixel."""
WORST = 250
"""Of a label that a view contradicts: correlation 0 or less."""


@kernel(fastmath=_FASTMATH)
def compute_ncc_costs(
    reference: Float32,
    base: Float32,
    offsets: Float64,
    source: Float32,
    turned: Float64,
    shift: Float64,
    radius: int,
    noise: float,
    costs: UInt8,
) -> None:
    """Cost of each label by one source view: 1 - correlation of windows, in 250ths.

    The window is warped with each pixel's own depth, so that it is slanted as the base surface is.

    Args:
        reference, base: (h, w) grey values, and depth of the base surface (0: unknown).
        offsets: (k,) of log depth. source: (H, W) grey values.
        turned, shift: (3, 3), (3,): a pixel (x, y, 1) of depth d is seen at d * turned @ (x, y, 1)
            + shift, homogeneous pixels of the source.
        radius: of the window. noise: variance of grey values that is no texture.
        costs: (k, h, w) uint8, written.
    """
    height, width = reference.shape
    rows, columns = source.shape
    warped = np.zeros((height, width), np.float32)
    seen = np.zeros((height, width), np.float32)
    column_sums = np.zeros((6, width), np.float32)
    for label in range(len(offsets)):
        factor = np.float32(math.exp(offsets[label]))
        for i in range(height):
            y = i + 0.5
            start0 = turned[0, 1] * y + turned[0, 2]
            start1 = turned[1, 1] * y + turned[1, 2]
            start2 = turned[2, 1] * y + turned[2, 2]
            for j in range(width):
                x = j + 0.5
                depth = base[i, j] * factor
                w = depth * (turned[2, 0] * x + start2) + shift[2]
                warped[i, j] = 0.0
                seen[i, j] = 0.0
                if depth <= 0.0 or w <= 1e-6:
                    continue
                inverse = 1.0 / w
                u = (depth * (turned[0, 0] * x + start0) + shift[0]) * inverse - 0.5
                v = (depth * (turned[1, 0] * x + start1) + shift[1]) * inverse - 0.5
                if u < 0.0 or v < 0.0 or u >= columns - 1 or v >= rows - 1:
                    continue
                c, r = int(u), int(v)
                a, b = np.float32(u - c), np.float32(v - r)
                top = source[r, c] + a * (source[r, c + 1] - source[r, c])
                bottom = source[r + 1, c] + a * (source[r + 1, c + 1] - source[r + 1, c])
                warped[i, j] = top + b * (bottom - top)
                seen[i, j] = 1.0
        for i in range(height):
            first, last = max(0, i - radius), min(height - 1, i + radius)
            column_sums[:] = 0.0
            for k in range(first, last + 1):
                for j in range(width):
                    ours, theirs, weight = reference[k, j], warped[k, j], seen[k, j]
                    column_sums[0, j] += weight
                    column_sums[1, j] += ours * weight
                    column_sums[2, j] += theirs
                    column_sums[3, j] += ours * ours * weight
                    column_sums[4, j] += theirs * theirs
                    column_sums[5, j] += ours * theirs
            for j in range(width):
                if seen[i, j] == 0.0:
                    costs[label, i, j] = UNSEEN
                    continue
                n = s1 = s2 = s11 = s22 = s12 = np.float32(0.0)
                for k in range(max(0, j - radius), min(width - 1, j + radius) + 1):
                    n += column_sums[0, k]
                    s1 += column_sums[1, k]
                    s2 += column_sums[2, k]
                    s11 += column_sums[3, k]
                    s22 += column_sums[4, k]
                    s12 += column_sums[5, k]
                inverse_n = np.float32(1.0) / n
                ours = s11 * inverse_n - (s1 * inverse_n) ** 2 + noise
                theirs = s22 * inverse_n - (s2 * inverse_n) ** 2 + noise
                both = s12 * inverse_n - s1 * s2 * inverse_n * inverse_n
                correlation = both / math.sqrt(max(ours * theirs, 1e-12))
                cost = (1.0 - correlation) * WORST
                costs[label, i, j] = np.uint8(min(max(cost, 0.0), WORST))


@kernel(fastmath=_FASTMATH)
def merge_view_costs(costs: UInt8, share: float, unseen: float, joined: Float32) -> None:
    """Mean cost over the better views of each pixel and label.

    ``costs``: (v, k, h, w). ``share``: of the views that see a pixel, which count (rounded up).
    ``unseen``: cost where none does, 0 to 1. ``joined``: (h, w, k) float32 in [0, 1], written.
    """
    views, labels, height, width = costs.shape
    each = np.empty(views, np.int64)
    for i in range(height):
        for label in range(labels):
            for j in range(width):
                n = 0
                for view in range(views):
                    cost = costs[view, label, i, j]
                    if cost != UNSEEN:
                        k = n
                        while k > 0 and each[k - 1] > cost:
                            each[k] = each[k - 1]
                            k -= 1
                        each[k] = cost
                        n += 1
                if n == 0:
                    joined[i, j, label] = unseen
                    continue
                kept = max(1, math.ceil(share * n - 1e-6))
                total = 0
                for k in range(kept):
                    total += each[k]
                joined[i, j, label] = total / (WORST * kept)


@kernel(fastmath=_FASTMATH)
def _aggregate_path(
    costs: Float32,
    guide: Float32,
    small: float,
    large: float,
    edge: float,
    row_step: int,
    column_step: int,
    total: Float32,
) -> None:
    """One direction of semi-global matching, added to ``total``."""
    height, width, labels = costs.shape
    before = np.zeros((width, labels), np.float32)
    here = np.zeros((width, labels), np.float32)
    lowest_before = np.zeros(width, np.float32)
    lowest_here = np.zeros(width, np.float32)
    for count in range(height):
        i = count if row_step >= 0 else height - 1 - count
        along_row = row_step == 0
        for number in range(width):
            j = number if column_step >= 0 else width - 1 - number
            pi, pj = i - row_step, j - column_step
            outside = pi < 0 or pi >= height or pj < 0 or pj >= width
            lowest = np.float32(1e30)
            if outside:
                for k in range(labels):
                    value = costs[i, j, k]
                    here[j, k] = value
                    lowest = min(lowest, value)
            else:
                source = here if along_row else before
                base = lowest_here[pj] if along_row else lowest_before[pj]
                jump = large / (1.0 + abs(guide[i, j] - guide[pi, pj]) / edge)
                limit = np.float32(base + max(jump, small))
                for k in range(labels):
                    best = min(source[pj, k], limit)
                    if k > 0:
                        best = min(best, source[pj, k - 1] + np.float32(small))
                    if k + 1 < labels:
                        best = min(best, source[pj, k + 1] + np.float32(small))
                    value = costs[i, j, k] + best - base
                    here[j, k] = value
                    lowest = min(lowest, value)
            lowest_here[j] = lowest
            for k in range(labels):
                total[i, j, k] += here[j, k]
        if not along_row:
            before, here = here, before
            lowest_before, lowest_here = lowest_here, lowest_before


def aggregate_costs(
    costs: Float32, guide: Float32, small: float, large: float, edge: float, total: Float32
) -> None:
    """Semi-global matching along eight directions.

    ``costs``: (h, w, k). ``guide``: (h, w) grey values. ``small``, ``large``: penalties of steps of
    one label and of more; the latter is halved where grey values differ by ``edge``. ``total``:
    (h, w, k) float32, the sum over directions is added.
    """
    for row_step in (-1, 0, 1):
        for column_step in (-1, 0, 1):
            if row_step or column_step:
                _aggregate_path(costs, guide, small, large, edge, row_step, column_step, total)


@kernel(fastmath=_FASTMATH)
def select_labels(
    total: Float32, costs: Float32, offsets: Float64, offset: Float32, cost: Float32
) -> None:
    """Offset of log depth of the best label, between labels by a parabola, and its own cost.

    ``total``: aggregated costs (h, w, k), ``costs``: those before. ``offsets``: (k,) of the labels,
    evenly spaced. ``offset``, ``cost``: (h, w) float32, written.
    """
    height, width, labels = total.shape
    step = offsets[1] - offsets[0]
    for i in range(height):
        for j in range(width):
            best = 0
            for k in range(1, labels):
                if total[i, j, k] < total[i, j, best]:
                    best = k
            fraction = 0.0
            if 0 < best < labels - 1:
                left, right = total[i, j, best - 1], total[i, j, best + 1]
                bend = left + right - 2 * total[i, j, best]
                if bend > 1e-9:
                    fraction = 0.5 * (left - right) / bend
            offset[i, j] = offsets[best] + fraction * step
            cost[i, j] = costs[i, j, best]
