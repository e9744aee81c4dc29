"""Multi-view stereo by plane-sweep along the surface of the input depth, coarse to fine.

Each depth hypothesis (label) is an offset of log depth from the surface of the input depth map. The
plane sweep warps all pixels of a label into a source view with their own depth, so that NCC windows
follow the slant of the surface. Semi-global matching (Hirschmueller, PAMI 2008) aggregates the
matching costs. The next finer pyramid level searches a few labels around the coarse depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD
from mpsfm_core.dense.stereo_kernels import (
    add_prior_costs,
    aggregate_costs,
    compute_ncc_costs,
    merge_view_costs,
    select_labels,
)
from mpsfm_core.geometry import resize_map

_RANGE_STDS = 2.0
"""Half width of the depth search range in stds of the input depth [ours]."""
_MAX_LABELS = 96
"""Maximum number of depth hypotheses per pixel on the coarse level; bounds the memory [ours]."""
WINDOW_RADIUS = 3
"""Radius of the NCC window in pixels of the pyramid level [ours]."""
_GRAY_NOISE = 2.0
"""Std of image noise in gray levels of 255. Raising the noise std treats more texture as noise
[ours]."""
_MERGED_VIEW_RATIO = 0.5
"""Ratio of source views whose matching costs are averaged, the lowest costs first [ours].

The source views with the highest matching costs are treated as occluded. Averaging more source
views is less robust to occlusion."""
_PRIOR_WEIGHT = 0.02
"""Matching cost per squared deviation from the input depth, in stds of the input depth [ours]."""
_SMALL_STEP_PENALTY = 0.04
"""Penalty P1 of semi-global matching for neighboring pixels one label apart [ours]."""
_LARGE_STEP_PENALTY = 1.6
"""Penalty P2 of semi-global matching for larger label steps, reduced at image edges [ours]."""
_LEVELS = (2, 1)
"""Downsampling factors of the pyramid levels, coarse to fine."""
_FINE_LABELS = 5
"""Number of labels on each side of the coarse depth, about a pixel of parallax apart [ours]."""
_UNSEEN_COST = 0.6
"""Matching cost of a depth that projects outside all source views, similar to a wrong match
[ours]."""
_UNRELATED_COST = 0.8
"""Matching cost of windows of different surfaces, the median on textured surfaces
[tuned: benchmarks.street]."""
_INFINITE_DEPTH_RATIO = 1e4
"""Ratio of a depth that counts as infinite to the largest input depth."""
_GAIN_RADIUS = 7
"""Radius in pixels of the window in which the cost gain is averaged [tuned: benchmarks.street]."""
_GRAY_EDGE = 10 / 255
"""Difference of gray values that halves the penalty P2 of a depth step [ours]."""
_MAX_PRIOR = 9.0
"""Maximum of the squared deviation from the input depth, in squared stds."""
_OUT_OF_RANGE_COST = 4.0
"""Cost of a depth outside the search range, several times the worst matching cost [ours]."""
_PARALLAX_SAMPLES = 8
"""Number of samples of the parallax along each side of the image."""


@dataclass(frozen=True, eq=False)
class StereoDepth:
    """Depth map from multi-view stereo, before the consistency check."""

    log_depth: Float32
    """(h, w) natural log of the stereo depth in world units."""
    cost: Float32
    """(h, w) matching cost: mean of ``1 - NCC`` over the best views, in [0, 1]."""
    cost_gain: Float32
    """(h, w) cost of unrelated windows or of infinite depth, whichever is lower, minus the cost of
    the stereo depth, averaged over a window. Sky and pixels without a match have a low gain."""
    parallax: Float32
    """(8, 8) motion in pixels of a point's projection in the source views per unit of log depth."""


def match_stereo_depth(view: DenseView, sources: Sequence[DenseView]) -> StereoDepth:
    """Estimate the depth of a view from one or more source views."""
    log_depth = np.zeros((0, 0), np.float32)
    for factor in _LEVELS:
        level_view = view.downsample(factor)
        level_sources = [source.downsample(factor) for source in sources]
        parallax = measure_parallax(level_view, level_sources)
        step = 1 / max(float(np.median(parallax)), 1e-6)
        if factor == _LEVELS[0]:
            log_depth = level_view.log_depth
            reach = _RANGE_STDS * float(np.median(level_view.log_std))
            count = int(np.clip(np.ceil(2 * reach / step), 2, _MAX_LABELS - 1))
            offsets: Float64 = np.linspace(-reach, reach, count + 1)
        else:
            log_depth = resize_map(cv2.medianBlur(log_depth, 3), *level_view.camera.size)
            offsets = (np.arange(-_FINE_LABELS, _FINE_LABELS + 1) * step).astype(np.float64)
        log_depth, cost = _sweep(level_view, level_sources, log_depth, offsets)
    return StereoDepth(log_depth, cost, _measure_cost_gain(view, sources, cost), parallax)


def _measure_cost_gain(view: DenseView, sources: Sequence[DenseView], cost: Float32) -> Float32:
    """Compute how much better stereo depth matches than infinite depth and unrelated windows."""
    infinite = np.full_like(cost, _INFINITE_DEPTH_RATIO * np.exp(view.log_depth.max()))
    infinite_cost = _match_costs(view, sources, infinite, np.zeros(1), _UNRELATED_COST)[..., 0]
    gain = np.minimum(infinite_cost, np.float32(_UNRELATED_COST)) - cost
    window = 2 * _GAIN_RADIUS + 1
    return np.asarray(cv2.blur(gain, (window, window)), np.float32)


def _sweep(
    view: DenseView,
    sources: Sequence[DenseView],
    surface: Float32,
    offsets: Float64,
) -> tuple[Float32, Float32]:
    """Search the log depth offset from a surface with the lowest matching cost at each pixel.

    Args:
        view: Reference view.
        sources: Source views on the pyramid level of the reference view.
        surface: (h, w) log depth of the base surface.
        offsets: (k,) labels, evenly spaced offsets of log depth.

    Returns:
        Natural log of depth, and matching cost, both (h, w).
    """
    base = np.where(view.usable, np.exp(surface), np.float32(0))
    merged = _match_costs(view, sources, base, offsets, _UNSEEN_COST)
    unary, total = np.empty_like(merged), np.zeros_like(merged)
    reach = _search_range(view) + (offsets[1] - offsets[0])
    add_prior_costs(
        merged,
        surface - view.log_depth,
        view.log_std,
        reach,
        offsets.astype(np.float32),
        np.float32(_PRIOR_WEIGHT),
        np.float32(_MAX_PRIOR),
        np.float32(_OUT_OF_RANGE_COST),
        unary,
    )
    penalties = _SMALL_STEP_PENALTY, _LARGE_STEP_PENALTY
    aggregate_costs(unary, view.gray, *penalties, _GRAY_EDGE, total)
    offset, cost = np.empty_like(base), np.empty_like(base)
    select_labels(total, merged, offsets, offset, cost)
    return surface + offset, cost


def _match_costs(
    view: DenseView,
    sources: Sequence[DenseView],
    base: Float32,
    offsets: Float64,
    unseen_cost: float,
) -> Float32:
    """Compute the matching costs (h, w, k) of k log depth offsets from a depth map (h, w).

    The costs are averaged over the best source views; pixels outside all source views have the cost
    ``unseen_cost``.
    """
    costs = np.empty((len(sources), len(offsets), *base.shape), np.uint8)
    noise_variance = (_GRAY_NOISE / 255) ** 2
    for source, source_costs in zip(sources, costs, strict=True):
        compute_ncc_costs(
            view.gray,
            base,
            offsets,
            source.gray,
            *source.pixels_from(view),
            WINDOW_RADIUS,
            noise_variance,
            source_costs,
        )
    merged = np.empty((*base.shape, len(offsets)), np.float32)
    merge_view_costs(costs, _MERGED_VIEW_RATIO, unseen_cost, merged)
    return merged


def _search_range(view: DenseView) -> Float32:
    """Compute the half width (h, w) of the search range in log depth.

    The median std of input depth is a lower bound of each pixel's std. At holes of the input depth,
    the search range contains all labels.
    """
    known = view.log_std[view.log_std < UNKNOWN_LOG_STD]
    median_std = np.median(known) if len(known) else UNKNOWN_LOG_STD
    reach: Float32 = np.float32(_RANGE_STDS) * np.maximum(view.log_std, np.float32(median_std))
    return reach


def measure_parallax(view: DenseView, sources: Sequence[DenseView]) -> Float32:
    """Compute how far projections in the source views move per unit of log depth (8, 8).

    The parallax is the maximum over the source views, and at least a small positive value.
    """
    width, height = view.camera.size
    samples = _PARALLAX_SAMPLES
    y, x = ((np.arange(samples) + 0.5) * size / samples for size in (height, width))
    pixels = np.stack([*np.meshgrid(x, y), np.ones((samples, samples))], axis=-1)
    depth = np.exp(view.log_depth[np.ix_(y.astype(int), x.astype(int))]).astype(np.float64)
    parallax = np.zeros((samples, samples))
    for source in sources:
        matrix, offset = source.pixels_from(view)
        ray = depth[..., None] * (pixels @ matrix.T)
        projected = ray + offset
        z = np.maximum(projected[..., 2:], 1e-9)
        derivative = ray[..., :2] / z - projected[..., :2] * ray[..., 2:] / z**2
        in_front = projected[..., 2] > 1e-6
        moved_px = np.where(in_front, np.linalg.norm(derivative, axis=-1), 0)
        parallax = np.maximum(parallax, moved_px)
    min_parallax = max(float(np.median(parallax)) * 0.05, 1e-3)
    return np.maximum(parallax, min_parallax).astype(np.float32)
