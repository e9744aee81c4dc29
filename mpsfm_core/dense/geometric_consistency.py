"""Geometric consistency check between the depth maps of several views."""
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

_MAX_DIFFERENCE_STDS = 3.0
"""Maximum difference of consistent depths, in stds of the difference."""
_MIN_TOLERANCE, _MAX_TOLERANCE = 0.005, 0.05
"""Minimum and maximum difference in log depth of consistent depths, whatever their std [ours]."""
_ERROR_CORRELATION = 0.3
"""Correlation of the errors of consistent depth maps [tuned: benchmarks.dense]."""
_COINCIDENCE_RATIO = 0.5
"""Ratio of nearly consistent to consistent pixels above which consistency may be chance [ours]."""
_MIN_PATCH_RATIO = 0.25
"""Minimum ratio of matched patches in an image pair with many nearly consistent pixels [ours].

In image pairs with correct poses, 0.2 to 0.8 of the patches match."""


@dataclass(frozen=True, eq=False)
class GeometricConsistency:
    """Consistency of one depth map with the depth maps of other views."""

    views: NDArray[np.uint16]
    """(h, w) number of views with consistent depth. A single consistent view confirms the depth of
    a pixel, because two wrong depths are rarely equal."""
    mean_change: Float32
    """(h, w) mean of the consistent log depths of all views minus the log depth of this view."""
    parallax_px: Float32
    """(h, w) maximum motion in pixels per unit of log depth of a point's projection in the
    consistent views, 0 at unconfirmed pixels."""
    match_std_px: float
    """Std of a stereo match in pixels, estimated from depth differences (NaN without consistent
    pixels)."""
    pose_std_px: float = 0.0
    """Std of a stereo match in pixels due to pose errors, which depth differences do not
    contain."""

    @property
    def confirmed(self) -> Bool:
        """(h, w) mask of pixels whose depth at least one other view confirms."""
        return self.views > 0

    @property
    def log_std(self) -> Float32:
        """(h, w) std of the mean of consistent log depths, infinite at unconfirmed pixels."""
        with np.errstate(divide="ignore"):
            return self.std_px / self.parallax_px

    @property
    def std_px(self) -> Float32:
        """(h, w) std of the mean of consistent depths, as std of a stereo match in pixels.

        Because the errors of depth maps are correlated, depth differences alone underestimate the
        std of the mean.
        """
        views = self.views.astype(np.float32)
        correlation = _ERROR_CORRELATION
        mean = self.match_std_px**2 * (1 + correlation * views) / ((1 - correlation) * (1 + views))
        std: Float32 = np.sqrt(mean + self.pose_std_px**2).astype(np.float32)
        return std


class PosedDepth(NamedTuple):
    """Log depth map of a view with pose and std."""

    grid: PosedGrid
    log_depth: Float32
    """(h, w) natural log of z-depth in world units."""
    log_std: Float32
    """(h, w) std of the log depth."""


class DepthDifferences(NamedTuple):
    """Log depth differences between the depth maps of two views."""

    log_depth: Float32
    """(h, w) difference of log depth, NaN at inconsistent pixels and outside the second view."""
    near_miss: Bool
    """(h, w) mask of nearly consistent pixels, whose depths differ by one to two times the
    tolerance."""

    @property
    def agree(self) -> Bool:
        """(h, w) mask of pixels whose depths are consistent."""
        return np.isfinite(self.log_depth)

    def where(self, usable: Bool) -> DepthDifferences:
        """Return the depth differences at the pixels of a mask (h, w)."""
        return DepthDifferences(
            np.where(usable, self.log_depth, np.float32(np.nan)), self.near_miss & usable
        )

    def is_coincidental(self, matched_patch_ratio: float) -> bool:
        """Return True if the consistency of two depth maps may be chance.

        If depths agree by chance, nearly consistent pixels are as frequent as consistent pixels.

        Args:
            matched_patch_ratio: Ratio of patches at consistent pixels whose gray values match in
                both views.
        """
        near_miss, agree = int(self.near_miss.sum()), int(self.agree.sum())
        return near_miss > _COINCIDENCE_RATIO * agree and matched_patch_ratio < _MIN_PATCH_RATIO


def compare_depths(reference: PosedDepth, source: PosedDepth) -> DepthDifferences:
    """Warp a depth map into a source view and compare the log depths of both views."""
    differences = np.full(reference.log_depth.shape, np.nan, np.float32)
    near_miss = np.zeros(differences.shape, np.bool_)
    matrix, offset = source.grid.pixels_from(reference.grid)
    _compare(*reference[1:], matrix, offset, *source[1:], differences, near_miss)
    return DepthDifferences(differences, near_miss)


def evaluate_consistency(
    shape: tuple[int, int],
    differences: Iterable[tuple[Float32, Float32]],
    pose_std_px: float = 0.0,
) -> GeometricConsistency:
    """Merge the depth differences to several views and estimate the std of a match.

    The depth difference of two views contains the errors of two stereo matches.

    Args:
        shape: (h, w) of the depth map.
        differences: Log depth differences (h, w) to each view, see :class:`DepthDifferences`, and
            motion (h, w) in pixels of a point's projection in the view per unit of log depth.
        pose_std_px: Std of a stereo match in pixels due to pose errors.
    """
    views, moves_px = np.zeros(shape, np.uint16), []
    change, largest_parallax = np.zeros((2, *shape), np.float32)
    for difference, parallax in differences:
        agree = np.isfinite(difference)
        views += agree
        change[agree] += difference[agree]
        largest_parallax[agree] = np.maximum(largest_parallax[agree], parallax[agree])
        moves_px.append(np.abs(difference[agree]) * parallax[agree])
    moves = np.concatenate([np.zeros(0, np.float32), *moves_px])
    std = float(np.quantile(moves, ONE_SIGMA)) / math.sqrt(2) if len(moves) else math.nan
    mean_change = change / (1 + views.astype(np.float32))
    return GeometricConsistency(views, mean_change, largest_parallax, std, pose_std_px)


def splat_depth(grid: PosedGrid, sources: Iterable[tuple[PosedGrid, Float32, Bool]]) -> Float32:
    """Project masked pixels of other views into a grid with a z-buffer (nearest depth wins).

    Args:
        grid: Target grid.
        sources: Grid, log depth (h, w), and mask (h, w) of the projected pixels of each source
            view.

    Returns:
        Log depth (h, w), infinite where no pixel projects.
    """
    splatted = np.full(grid.shape, np.inf, np.float32)
    for source, depth, mask in sources:
        matrix, offset = grid.pixels_from(source)
        _splat(depth, mask, matrix, offset, splatted)
    return splatted


@kernel()
def _compare(
    log_depth: Float32,
    log_std: Float32,
    matrix: Float64,
    offset: Float64,
    source: Float32,
    source_std: Float32,
    differences: Float32,
    near_miss: Bool,
) -> None:
    """Compute log depth differences and nearly consistent pixels of two depth maps."""
    height, width = log_depth.shape
    rows, columns = source.shape
    for i in range(height):
        for j in range(width):
            x, y = j + 0.5, i + 0.5
            depth = math.exp(log_depth[i, j])
            w = depth * (matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]) + offset[2]
            if w <= 1e-6:
                continue
            u = (depth * (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) + offset[0]) / w
            v = (depth * (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) + offset[1]) / w
            if u < 0 or v < 0 or u >= columns or v >= rows:
                continue
            r, c = int(v), int(u)
            variance = log_std[i, j] ** 2 + source_std[r, c] ** 2
            limit = _MAX_DIFFERENCE_STDS * math.sqrt(variance)
            tolerance = min(max(limit, _MIN_TOLERANCE), _MAX_TOLERANCE)
            difference = source[r, c] - math.log(w)
            if abs(difference) <= tolerance:
                differences[i, j] = difference
            elif abs(difference) <= 2 * tolerance:
                near_miss[i, j] = True


@kernel()
def _splat(depth: Float32, mask: Bool, matrix: Float64, offset: Float64, splatted: Float32) -> None:
    """Project the masked pixels of one view into a z-buffer of log depth."""
    height, width = depth.shape
    rows, columns = splatted.shape
    for i in range(height):
        for j in range(width):
            if not mask[i, j]:
                continue
            x, y, d = j + 0.5, i + 0.5, math.exp(depth[i, j])
            w = d * (matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]) + offset[2]
            if w <= 1e-6:
                continue
            u = (d * (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) + offset[0]) / w
            v = (d * (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) + offset[1]) / w
            if u >= 0 and v >= 0 and u < columns and v < rows:
                r, c = int(v), int(u)
                splatted[r, c] = min(splatted[r, c], np.float32(math.log(w)))
