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

    Each pixel of a window is warped with its own depth, so the window follows the base surface. The
    loops over the columns of a row contain few branches, so that they are vectorized.

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
    us, vs = np.zeros(width, np.float32), np.zeros(width, np.float32)
    # Sums over the rows and over all pixels of a window: number of pixels, gray values of both
    # views, their squares, and their product. The sums of rows have a border of `radius` zeros.
    column_sums = np.zeros((6, width + 2 * radius), np.float32)
    sums = np.zeros((6, width), np.float32)
    ux, vx, wx = np.float32(matrix[0, 0]), np.float32(matrix[1, 0]), np.float32(matrix[2, 0])
    u0, v0, w0 = np.float32(offset[0]), np.float32(offset[1]), np.float32(offset[2])
    half, noise_variance = np.float32(0.5), np.float32(noise)
    for label in range(len(offsets)):
        factor = np.float32(math.exp(offsets[label]))
        column_sums[:] = 0.0
        for last in range(height + radius):
            if last < height:
                y = last + 0.5
                ray_u = np.float32(matrix[0, 1] * y + matrix[0, 2])
                ray_v = np.float32(matrix[1, 1] * y + matrix[1, 2])
                ray_w = np.float32(matrix[2, 1] * y + matrix[2, 2])
                for j in range(width):
                    x = np.float32(j) + half
                    depth = base[last, j] * factor
                    w = depth * (wx * x + ray_w) + w0
                    inverse = np.float32(1.0) / w
                    us[j] = (depth * (ux * x + ray_u) + u0) * inverse - half
                    vs[j] = (depth * (vx * x + ray_v) + v0) * inverse - half
                    if depth <= 0.0 or w <= np.float32(1e-6):
                        us[j] = np.float32(-1.0)
                for j in range(width):
                    u, v = us[j], vs[j]
                    if u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1:
                        c, r = int(u), int(v)
                        a, b = u - np.float32(c), v - np.float32(r)
                        top = source[r, c] + a * (source[r, c + 1] - source[r, c])
                        bottom = source[r + 1, c] + a * (source[r + 1, c + 1] - source[r + 1, c])
                        warped[last, j] = top + b * (bottom - top)
                        seen[last, j] = 1.0
                    else:
                        warped[last, j] = 0.0
                        seen[last, j] = 0.0
                for j in range(width):
                    gray, source_gray = seen[last, j] * reference[last, j], warped[last, j]
                    column_sums[0, j + radius] += seen[last, j]
                    column_sums[1, j + radius] += gray
                    column_sums[2, j + radius] += source_gray
                    column_sums[3, j + radius] += gray * gray
                    column_sums[4, j + radius] += source_gray * source_gray
                    column_sums[5, j + radius] += gray * source_gray
            first = last - 2 * radius - 1
            if first >= 0:
                for j in range(width):
                    gray, source_gray = seen[first, j] * reference[first, j], warped[first, j]
                    column_sums[0, j + radius] -= seen[first, j]
                    column_sums[1, j + radius] -= gray
                    column_sums[2, j + radius] -= source_gray
                    column_sums[3, j + radius] -= gray * gray
                    column_sums[4, j + radius] -= source_gray * source_gray
                    column_sums[5, j + radius] -= gray * source_gray
            i = last - radius
            if i < 0:
                continue
            for k in range(6):
                for j in range(width):
                    sums[k, j] = column_sums[k, j]
                for column in range(1, 2 * radius + 1):
                    for j in range(width):
                        sums[k, j] += column_sums[k, j + column]
            for j in range(width):
                inverse_n = np.float32(1.0) / max(sums[0, j], np.float32(1.0))
                mean, source_mean = sums[1, j] * inverse_n, sums[2, j] * inverse_n
                variance = sums[3, j] * inverse_n - mean * mean + noise_variance
                source_variance = sums[4, j] * inverse_n - source_mean**2 + noise_variance
                covariance = sums[5, j] * inverse_n - mean * source_mean
                ncc = covariance / np.sqrt(max(variance * source_variance, np.float32(1e-12)))
                cost = min(max((np.float32(1.0) - ncc) * MAX_COST, np.float32(0.0)), MAX_COST)
                costs[label, i, j] = np.uint8(cost) if seen[i, j] > 0.0 else np.uint8(UNSEEN)


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


@kernel()
def add_prior_costs(
    costs: Float32,
    change: Float32,
    std: Float32,
    reach: Float64,
    offsets: Float32,
    weight: np.float32,
    max_prior: np.float32,
    out_of_range: np.float32,
    total: Float32,
) -> None:
    """Add the cost of the deviation from the input depth to the matching cost of each label.

    Args:
        costs: (h, w, k) matching costs of k labels at each pixel.
        change: (h, w) log depth of the base surface minus log depth of the input depth.
        std: (h, w) std of the log of the input depth.
        reach: (h, w) half width of the search range in log depth.
        offsets: (k,) offsets of log depth of the labels from the base surface.
        weight: Cost per squared deviation in stds.
        max_prior: Maximum squared deviation in squared stds.
        out_of_range: Cost of a depth outside the search range.
        total: (h, w, k) float32 output, the sum of both costs.
    """
    height, width, labels = costs.shape
    for i in range(height):
        for j in range(width):
            for k in range(labels):
                deviation = change[i, j] + offsets[k]
                stds = deviation / std[i, j]
                cost = costs[i, j, k] + weight * min(stds * stds, max_prior)
                total[i, j, k] = out_of_range if abs(deviation) > reach[i, j] else cost


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
