"""Depth of one view from its source views: a search along the known surface, coarse to fine.

A label is an offset of log depth from the surface that is known before. All pixels of a label are
warped together into a source view, so that windows are slanted as that surface is and a label costs
a few dozen operations a pixel whatever the window. Semi-global matching (Hirschmueller, PAMI 2008)
joins the costs; smooth is what runs along the known surface. Then the same around what was found,
on the next finer grid, with a few labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.stereo_kernels import (
    aggregate_costs,
    compute_ncc_costs,
    merge_view_costs,
    select_labels,
)
from mpsfm_core.geometry import resize_map

_LEVELS = (2, 1)
"""Reductions of the grid, coarse to fine."""
_FINE_LABELS = 5
"""Labels to each side on all grids but the coarsest; one is about a pixel of parallax (ours)."""
_UNSEEN_COST = 0.6
"""Of a depth at which no view sees the pixel: about that of texture that does not match (ours)."""
_EDGE = 10 / 255
"""Step of grey values that halves the penalty of a step of depth (ours)."""
_MAX_PRIOR = 9.0
"""Squared deviation from the known depth, in std, above which more costs no more."""
_BEYOND = 4.0
"""Cost of a depth further from the known one than is searched (ours: several times the worst)."""
_SAMPLES = 8
"""Pixels along each side at which parallax is measured."""


@dataclass(frozen=True, eq=False)
class StereoDepth:
    """What the photos say, float32.

    ``log_depth``: (h, w). ``cost``: (h, w), 1 - correlation of the better views, 0 to 1.
    ``parallax``: on a coarse grid that covers the map, pixels of the map that a point moves in the
    source views when its log depth changes by one.
    """

    log_depth: Float32
    cost: Float32
    parallax: Float32


def match_stereo_depth(
    view: DenseView, sources: Sequence[DenseView], options: DenseOptions
) -> StereoDepth:
    """Search the depth of ``view`` in one or more source views."""
    log_depth = np.zeros((0, 0), np.float32)
    for factor in _LEVELS:
        own, others = view.reduced(factor), [source.reduced(factor) for source in sources]
        parallax = _parallax(own, others)
        step = 1 / max(float(np.median(parallax)), 1e-6)
        if factor == _LEVELS[0]:
            log_depth = own.log_depth
            reach = options.range_stds * float(np.median(own.log_std))
            count = int(np.clip(np.ceil(2 * reach / step), 2, options.max_labels - 1))
            offsets: Float64 = np.linspace(-reach, reach, count + 1)
        else:
            log_depth = resize_map(cv2.medianBlur(log_depth, 3), *own.camera.size)
            offsets = (np.arange(-_FINE_LABELS, _FINE_LABELS + 1) * step).astype(np.float64)
        log_depth, cost = _search(own, others, log_depth, offsets, options)
    return StereoDepth(log_depth, cost, parallax)


def _search(
    view: DenseView,
    sources: Sequence[DenseView],
    surface: Float32,
    offsets: Float64,
    options: DenseOptions,
) -> tuple[Float32, Float32]:
    """Log depth and cost of the best offsets from a surface."""
    base = np.where(view.usable, np.exp(surface), np.float32(0))
    costs = np.empty((len(sources), len(offsets), *base.shape), np.uint8)
    noise = (options.grey_noise / 255) ** 2
    for source, plane in zip(sources, costs, strict=True):
        turned, shift = source.pixels_from(view)
        own, their = (view.grey, base, offsets), (source.grey, turned, shift)
        compute_ncc_costs(*own, *their, options.window_radius, noise, plane)
    joined = np.empty((*base.shape, len(offsets)), np.float32)
    merge_view_costs(costs, options.view_share, _UNSEEN_COST, joined)
    change = (surface - view.log_depth)[..., None] + offsets.astype(np.float32)
    deviation = change / view.log_std[..., None]
    weighed = joined + np.float32(options.prior_weight) * np.minimum(deviation**2, _MAX_PRIOR)
    weighed[np.abs(change) > _reach(view, options)[..., None] + (offsets[1] - offsets[0])] = _BEYOND
    total = np.zeros_like(joined)
    steps = options.small_step, options.large_step
    aggregate_costs(weighed.astype(np.float32), view.grey, *steps, _EDGE, total)
    offset, cost = np.empty_like(base), np.empty_like(base)
    select_labels(total, joined, offsets, offset, cost)
    return surface + offset, cost


def _reach(view: DenseView, options: DenseOptions) -> Float32:
    """Log depth (h, w) that is searched to either side of what is known; where that is surer than
    usual as far as usual, where nothing is known wherever there is a label."""
    known = view.log_std[view.log_std < UNKNOWN_LOG_STD]
    usual = np.median(known) if len(known) else UNKNOWN_LOG_STD
    reach: Float32 = np.float32(options.range_stds) * np.maximum(view.log_std, np.float32(usual))
    return reach


def _parallax(view: DenseView, sources: Sequence[DenseView]) -> Float32:
    """As :attr:`StereoDepth.parallax`.

    The largest among the views; far from all of them the small number that it is.
    """
    width, height = view.camera.size
    y, x = ((np.arange(_SAMPLES) + 0.5) * size / _SAMPLES for size in (height, width))
    pixels = np.stack([*np.meshgrid(x, y), np.ones((_SAMPLES, _SAMPLES))], axis=-1)
    depth = np.exp(view.log_depth[np.ix_(y.astype(int), x.astype(int))]).astype(np.float64)
    found = np.zeros((_SAMPLES, _SAMPLES))
    for source in sources:
        turned, shift = source.pixels_from(view)
        ray = depth[..., None] * (pixels @ turned.T)
        seen = ray + shift
        z = np.maximum(seen[..., 2:], 1e-9)
        moved = ray[..., :2] / z - seen[..., :2] * ray[..., 2:] / z**2
        ahead = seen[..., 2] > 1e-6
        found = np.maximum(found, np.where(ahead, np.linalg.norm(moved, axis=-1), 0))
    smallest = max(float(np.median(found)) * 0.05, 1e-3)
    return np.maximum(found, smallest).astype(np.float32)
