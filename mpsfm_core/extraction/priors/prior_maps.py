"""Conversion of predicted priors to the grid of the mapper."""

from __future__ import annotations

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, NormalPrior
from mpsfm_core.extraction.options import ExtractionOptions
from mpsfm_core.geometry import log_depth_steps, resize_map

EDGE_VARIANCE = 1e6
"""Variance of normals at depth edges, rad^2. [reference]"""
_ALL_VALID = 1 - 1e-5
"""Threshold of an interpolated mask: a pixel is valid if all contributing pixels are valid."""


def fit_to_grid(
    depth: DepthPrior,
    normals: NormalPrior,
    size: tuple[int, int],
    mask: Bool | None,
    options: ExtractionOptions,
) -> tuple[DepthPrior, NormalPrior]:
    """Resize priors to the grid of the mapper, apply the mask, and down-weight normals at edges.

    Args:
        depth: Depth prior with variance.
        normals: Normal prior with variance.
        size: (width, height) of the undistorted view in pixels.
        mask: (H, W) bool mask of usable pixels of the view, or None if all pixels are usable.
        options: Options with the size of the grid and the threshold of depth edges.
    """
    grid = integration_grid(size, options.integration_size)
    depth, normals = resize_depth(depth, grid), resize_normals(normals, grid)
    if mask is not None:
        allowed = resize_mask(mask, grid)
        depth, normals = mask_depth(depth, allowed), mask_normals(normals, allowed)
    if options.edge_ratio is not None:
        normals = inflate_edge_variance(normals, depth, options.edge_ratio)
    return depth, normals


def integration_grid(size: tuple[int, int], longer_side: int) -> tuple[int, int]:
    """Return (width, height) of the prior maps of an image, with the image's aspect ratio."""
    factor = longer_side / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def resize_depth(prior: DepthPrior, grid: tuple[int, int]) -> DepthPrior:
    """Resize a depth prior to a grid (width, height).

    Inverse depth, which is linear on planes, and relative variance are interpolated bilinearly, and
    averaged when shrinking. The variance is not divided by the number of averaged pixels, because
    errors of neighboring pixels are correlated. A pixel is valid if all contributing pixels are
    valid.
    """
    if (prior.shape[1], prior.shape[0]) == grid:
        return prior
    valid = _resize_valid(prior.valid, grid)
    safe = np.where(prior.valid, prior.depth, np.float32(1))
    inverse = resize_map(1.0 / safe, *grid)
    depth = np.where(valid, 1.0 / np.where(valid, inverse, np.float32(1)), np.float32(0))
    variance = None
    if prior.variance is not None:
        relative = resize_map(np.where(prior.valid, prior.variance / safe**2, 0), *grid)
        variance = np.where(valid, relative * depth**2, np.float32(0))
    return DepthPrior(depth, variance, valid, prior.metric)


def resize_normals(prior: NormalPrior, grid: tuple[int, int]) -> NormalPrior:
    """Resize a normal prior to a grid (width, height).

    The normals are averaged and normalized, and their variance is averaged. A pixel is valid if all
    contributing pixels are valid.
    """
    if (prior.shape[1], prior.shape[0]) == grid:
        return prior
    valid = _resize_valid(prior.valid, grid)
    normals = resize_map(prior.normals, *grid)
    variance = None if prior.variance is None else resize_map(prior.variance, *grid)
    return NormalPrior.from_arrays(normals, variance, valid)


def resize_mask(mask: Bool, grid: tuple[int, int]) -> Bool:
    """Resize a mask (H, W) to a grid (width, height) by nearest-neighbor interpolation."""
    resized = cv2.resize(mask.astype(np.uint8), grid, interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(resized > 0)


def mask_depth(prior: DepthPrior, allowed: Bool) -> DepthPrior:
    """Mark depth as invalid where the mask ``allowed`` is false."""
    return DepthPrior(prior.depth, prior.variance, prior.valid & allowed, prior.metric)


def mask_normals(prior: NormalPrior, allowed: Bool) -> NormalPrior:
    """Mark normals as invalid where the mask ``allowed`` is false."""
    return NormalPrior(prior.normals, prior.variance, prior.valid & allowed)


def inflate_edge_variance(normals: NormalPrior, depth: DepthPrior, ratio: float) -> NormalPrior:
    """Set the variance of normals on both sides of depth edges to :data:`EDGE_VARIANCE`.

    Args:
        normals: Normal prior with its variance.
        depth: Depth prior on the same grid; steps to invalid pixels are not edges.
        ratio: Ratio of neighboring depths above which two pixels are separated by a depth edge.
    """
    edges = log_depth_steps(depth.depth, depth.valid) > np.log(ratio)
    variance = np.where(edges & normals.valid, np.float32(EDGE_VARIANCE), _variance(normals))
    return NormalPrior(normals.normals, variance.astype(np.float32), normals.valid)


def _resize_valid(valid: Bool, grid: tuple[int, int]) -> Bool:
    return np.asarray(resize_map(valid, *grid) > _ALL_VALID)


def _variance(normals: NormalPrior) -> Float32:
    if normals.variance is None:
        raise ValueError("normals need a variance before depth edges are marked")
    return normals.variance
