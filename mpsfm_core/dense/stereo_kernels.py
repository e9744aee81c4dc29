"""Compiled kernels of multi-view stereo, for matching costs and semi-global matching.

All images and depth maps are float32 arrays of equal size. Stereo labels are offsets of log depth
from a base surface.
"""
# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from mpsfm_core.data import Float32, Float64, UInt8
from mpsfm_core.support.jit import kernel

_FASTMATH = {"contract", "reassoc", "arcp"}
"""LLVM fast-math flags that allow reordered sums but preserve NaN and infinity."""

UNSEEN = 255
"""Matching cost (uint8 code) of a label whose projection is outside the source view."""
MAX_COST = 250
"""Matching cost of a label with an NCC of 0 or less, where 250 corresponds to cost 1."""


@kernel(fastmath=_FASTMATH)
def compute_ncc_costs(
    reference: Float32,
    base: Float32,
    offsets: Float64,
    source: Float32,
    matrix: Float64,
    offset: Float64,
    radius: int,
    noise: float,
    costs: UInt8,
) -> None:
    """Compute the photo-consistency cost ``250 * (1 - NCC)`` of each label in one source view.

    Each pixel of a window is warped with its own depth, so the window follows the base surface.

    Args:
        reference: (h, w) gray values of the reference view.
        base: (h, w) depth of the base surface, 0 where unknown.
        offsets: (k,) labels, offsets of log depth from the base surface.
        source: (H, W) gray values of the source view.
        matrix: (3, 3) matrix such that pixel (x, y) of depth d projects to the homogeneous pixel
            ``d * matrix @ (x, y, 1) + offset`` of the source view.
        offset: (3,) offset in the projection to the source view.
        radius: Radius of the NCC window in pixels.
        noise: Variance of gray values due to image noise.
        costs: (k, h, w) uint8 output, the cost of each label.
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
            start0 = matrix[0, 1] * y + matrix[0, 2]
            start1 = matrix[1, 1] * y + matrix[1, 2]
            start2 = matrix[2, 1] * y + matrix[2, 2]
            for j in range(width):
                x = j + 0.5
                depth = base[i, j] * factor
                w = depth * (matrix[2, 0] * x + start2) + offset[2]
                warped[i, j] = 0.0
                seen[i, j] = 0.0
                if depth <= 0.0 or w <= 1e-6:
                    continue
                inverse = 1.0 / w
                u = (depth * (matrix[0, 0] * x + start0) + offset[0]) * inverse - 0.5
                v = (depth * (matrix[1, 0] * x + start1) + offset[1]) * inverse - 0.5
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
                    reference_value, source_value = reference[k, j], warped[k, j]
                    weight = seen[k, j]
                    column_sums[0, j] += weight
                    column_sums[1, j] += reference_value * weight
                    column_sums[2, j] += source_value
                    column_sums[3, j] += reference_value * reference_value * weight
                    column_sums[4, j] += source_value * source_value
                    column_sums[5, j] += reference_value * source_value
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
                reference_variance = s11 * inverse_n - (s1 * inverse_n) ** 2 + noise
                source_variance = s22 * inverse_n - (s2 * inverse_n) ** 2 + noise
                covariance = s12 * inverse_n - s1 * s2 * inverse_n * inverse_n
                ncc = covariance / math.sqrt(max(reference_variance * source_variance, 1e-12))
                cost = (1.0 - ncc) * MAX_COST
                costs[label, i, j] = np.uint8(min(max(cost, 0.0), MAX_COST))


@kernel(fastmath=_FASTMATH)
def merge_view_costs(costs: UInt8, ratio: float, unseen: float, merged: Float32) -> None:
    """Average the lowest matching costs over the source views, for each pixel and label.

    Args:
        costs: (v, k, h, w) matching costs of k labels in v source views.
        ratio: Ratio of the source views to average, among those that contain the pixel.
        unseen: Matching cost in [0, 1] of a pixel that projects outside all source views.
        merged: (h, w, k) float32 output, the merged costs in [0, 1].
    """
    views, labels, height, width = costs.shape
    sorted_costs = np.empty(views, np.int64)
    for i in range(height):
        for label in range(labels):
            for j in range(width):
                n = 0
                for view in range(views):
                    cost = costs[view, label, i, j]
                    if cost != UNSEEN:
                        k = n
                        while k > 0 and sorted_costs[k - 1] > cost:
                            sorted_costs[k] = sorted_costs[k - 1]
                            k -= 1
                        sorted_costs[k] = cost
                        n += 1
                if n == 0:
                    merged[i, j, label] = unseen
                    continue
                num_used = max(1, math.ceil(ratio * n - 1e-6))
                total = 0
                for k in range(num_used):
                    total += sorted_costs[k]
                merged[i, j, label] = total / (MAX_COST * num_used)


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
    """Add the path costs of one direction of semi-global matching to `total`."""
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
    """Aggregate costs by semi-global matching along eight directions.

    Args:
        costs: (h, w, k) matching costs of k labels at each pixel.
        guide: (h, w) gray values of the reference view.
        small: Penalty P1 for neighboring pixels one label apart.
        large: Penalty P2 for neighboring pixels more than one label apart.
        edge: Difference of gray values that halves P2.
        total: (h, w, k) float32 output, to which the path costs of all directions are added.
    """
    for row_step in (-1, 0, 1):
        for column_step in (-1, 0, 1):
            if row_step or column_step:
                _aggregate_path(costs, guide, small, large, edge, row_step, column_step, total)


@kernel(fastmath=_FASTMATH)
def select_labels(
    total: Float32, costs: Float32, offsets: Float64, offset: Float32, cost: Float32
) -> None:
    """Select the label of the lowest aggregated cost, refined by a parabola.

    Args:
        total: (h, w, k) aggregated costs.
        costs: (h, w, k) matching costs before aggregation.
        offsets: (k,) offsets of log depth of the labels, evenly spaced.
        offset: (h, w) float32 output, log depth offset of the selected label.
        cost: (h, w) float32 output, matching cost of the selected label before aggregation.
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
