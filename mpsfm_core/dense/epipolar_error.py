"""Pose errors of image pairs, estimated from patch offsets to epipolar lines.

The depth of a pixel moves its projection along the epipolar line only. The offset of a matched
patch perpendicular to the epipolar line is therefore a pose error. Pose errors along the epipolar
line are not observable, because the stereo depth absorbs them. If few patches match, the two images
probably show different surfaces.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.geometry.statistics import ONE_SIGMA

MAX_PATCHES = 100
"""Maximum number of patches per image pair [ours]."""
PATCH_RADIUS_PX = 7
"""Radius and maximum offset of a matched patch, both in pixels of the depth map [ours]."""
MIN_CORRELATION = 0.8
"""Minimum normalized cross-correlation (NCC) of a matched patch [ours]."""
_NOISE_CORRELATION_PX = 1.5
"""Correlation length of image noise in the downsampled view, in pixels."""
_LOG_DEPTH_STEP = 1e-2
"""Step of log depth for numeric differentiation, which gives the direction of the epipolar line."""


class PatchOffsets(NamedTuple):
    """Offsets of matched patches from their epipolar lines."""

    epipolar_px: Float64
    """(n,) signed distances of matched patches to epipolar lines, in pixels of the source view."""
    matched_ratio: float
    """Ratio in [0, 1] of the sampled patches that match in the source view."""


def estimate_pose_error_px(pairs: Iterable[PatchOffsets]) -> float:
    """Estimate the std of epipolar offsets of all image pairs in pixels (0 without matches)."""
    offsets = np.abs(np.concatenate([np.zeros(0), *(pair.epipolar_px for pair in pairs)]))
    return float(np.quantile(offsets, ONE_SIGMA)) if len(offsets) else 0.0


def measure_patch_offsets(
    view: DenseView, log_depth: Float32, source: DenseView, mask: Bool
) -> PatchOffsets:
    """Match patches of a reference view near their projections in a source view.

    Args:
        view: Reference view.
        log_depth: (h, w) log depth of the reference view.
        source: View to search.
        mask: (h, w) pixels from which patch centers are sampled evenly.
    """
    rows, columns = np.nonzero(mask)
    sampled = np.linspace(0, len(rows) - 1, min(MAX_PATCHES, len(rows))).astype(np.int64)
    rows, columns = rows[sampled], columns[sampled]
    xy = np.stack([columns, rows], axis=1).astype(np.float64) + 0.5
    depth: Float64 = np.exp(log_depth[rows, columns].astype(np.float64))
    matrix, offset = source.pixels_from(view)

    def project_to_source(pixels: Float64, depths: Float64) -> Float64:
        homogeneous = depths[:, None] * (pixels @ matrix[:, :2].T + matrix[:, 2]) + offset
        projected: Float64 = homogeneous[:, :2] / homogeneous[:, 2:]
        return projected

    source_xy = project_to_source(xy, depth)
    warp = np.stack([project_to_source(xy + step, depth) - source_xy for step in np.eye(2)], axis=2)
    line = project_to_source(xy, depth * np.exp(_LOG_DEPTH_STEP)) - source_xy
    length = np.linalg.norm(line, axis=1)
    alignment = align_patches(
        view.gray, source.gray, xy, source_xy, warp, PATCH_RADIUS_PX, _NOISE_CORRELATION_PX
    )
    near = np.linalg.norm(alignment.shift, axis=1) < PATCH_RADIUS_PX
    matched = (alignment.correlation > MIN_CORRELATION) & near & (length > 0)
    x, y = alignment.shift[matched].T
    epipolar_px = (y * line[matched, 0] - x * line[matched, 1]) / length[matched]
    return PatchOffsets(epipolar_px, len(epipolar_px) / max(len(sampled), 1))
