"""Subsample the points of the report page and measure their error, std and image count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mpsfm_core.data import Float32, Float64, Int64, UInt8
from mpsfm_core.geometry import inside, project, sample_nearest, transform
from mpsfm_core.report.result_folder import RefinedMap

_SIGMAS = 3.0
"""Maximum depth difference in standard deviations of a depth map that observes a point."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points with the values by which the report page colors points."""

    xyz: Float64
    """(n, 3) float64 points in world coordinates."""
    rgb: UInt8
    """(n, 3) uint8 RGB colors of the points."""
    error: Float32
    """(n,) float32 reprojection errors in pixels or relative depth differences in percent."""
    std: Float32
    """(n,) float32 minimum relative std in percent of the depth maps that observe the point, or
    NaN."""
    views: Float32
    """(n,) float32 numbers of images that observe each point."""
    error_unit: str
    """Unit of :attr:`error`, ``px`` or ``%``."""


def sparse_points(
    model: pycolmap.Reconstruction, maps: Sequence[RefinedMap], max_points: int
) -> PointSet:
    """Return a random subset of at most ``max_points`` triangulated points."""
    points = [model.points3D[key] for key in sorted(model.points3D)]
    points = [points[row] for row in _sample_rows(len(points), max_points)]
    xyz = np.array([p.xyz for p in points], np.float64).reshape(-1, 3)
    rgb = np.array([p.color for p in points], np.uint8).reshape(-1, 3)
    error = np.array([p.error for p in points], np.float32)
    views = np.array([p.track.length() for p in points], np.float32)
    std = _measure_observations(xyz, maps)[1]
    return PointSet(xyz, rgb, error, std, views, "px")


def dense_points(
    cloud: tuple[Float64, UInt8], maps: Sequence[RefinedMap], max_points: int
) -> PointSet:
    """Return a random subset of at most ``max_points`` points of the fused depth maps."""
    rows = _sample_rows(len(cloud[0]), max_points)
    xyz, rgb = cloud[0][rows], cloud[1][rows]
    error, std, views = _measure_observations(xyz, maps)
    return PointSet(xyz, rgb, error, std, views, "%")


def _sample_rows(count: int, max_rows: int) -> Int64:
    """Draw at most ``max_rows`` of ``count`` row indices with a fixed seed."""
    if count <= max_rows:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, max_rows, replace=False))


def _measure_observations(
    xyz: Float64, maps: Sequence[RefinedMap]
) -> tuple[Float32, Float32, Float32]:
    """Compare points with the depth maps that observe them.

    Returns:
        Mean relative depth difference in percent, minimum relative depth std in percent, and number
        of observing depth maps of each point.
    """
    total = np.zeros(len(xyz))
    views = np.zeros(len(xyz), np.float32)
    min_std = np.full(len(xyz), np.nan, np.float32)
    for refined in maps:
        local = transform(refined.rotation, refined.translation, xyz)
        pixels = project(refined.camera, local)
        rows = np.flatnonzero(inside(pixels, refined.camera.size) & (local[:, 2] > 0))
        rows = rows[sample_nearest(refined.valid, pixels[rows])]
        std = sample_nearest(refined.relative_std, pixels[rows])
        difference = np.abs(sample_nearest(refined.depth, pixels[rows]) / local[rows, 2] - 1)
        agrees = difference <= _SIGMAS * std
        rows, std, difference = rows[agrees], std[agrees], difference[agrees]
        total[rows] += difference
        views[rows] += 1
        min_std[rows] = np.fmin(min_std[rows], std)
    error = (100 * total / np.maximum(views, 1)).astype(np.float32)
    return error, 100 * min_std, views
