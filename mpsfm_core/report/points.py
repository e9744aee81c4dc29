"""The points of the page: thinned, and with what they can be coloured by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mpsfm_core.data import Float32, Float64, Int64, UInt8
from mpsfm_core.geometry import inside, project, sample_nearest, transform
from mpsfm_core.report.result_folder import RefinedMap

_SIGMAS = 3.0
"""A map sees a point when its depth there agrees within so many standard deviations, as the fused
cloud is made."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """``xyz`` (n, 3) float64, ``rgb`` (n, 3) uint8. ``error``: (n,) float32, reprojection error in
    pixels or relative disagreement of depth maps (``error_unit``: px or %). ``std``: (n,) float32,
    least relative std of a map that sees it, in percent, NaN where none does. ``views``: (n,)
    float32, images that see it."""

    xyz: Float64
    rgb: UInt8
    error: Float32
    std: Float32
    views: Float32
    error_unit: str


def sparse_points(
    model: pycolmap.Reconstruction, maps: Sequence[RefinedMap], most: int
) -> PointSet:
    """The triangulated points, at most so many."""
    points = [model.points3D[key] for key in sorted(model.points3D)]
    points = [points[row] for row in _some(len(points), most)]
    xyz = np.array([p.xyz for p in points], np.float64).reshape(-1, 3)
    rgb = np.array([p.color for p in points], np.uint8).reshape(-1, 3)
    error = np.array([p.error for p in points], np.float32)
    views = np.array([p.track.length() for p in points], np.float32)
    std = _seen(xyz, maps)[1]
    return PointSet(xyz, rgb, error, std, views, "px")


def dense_points(cloud: tuple[Float64, UInt8], maps: Sequence[RefinedMap], most: int) -> PointSet:
    """The fused depth maps, at most so many points."""
    chosen = _some(len(cloud[0]), most)
    xyz, rgb = cloud[0][chosen], cloud[1][chosen]
    error, std, views = _seen(xyz, maps)
    return PointSet(xyz, rgb, error, std, views, "%")


def _some(count: int, most: int) -> Int64:
    """Rows of at most ``most``, drawn evenly and always the same."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _seen(xyz: Float64, maps: Sequence[RefinedMap]) -> tuple[Float32, Float32, Float32]:
    """Of each point the mean relative disagreement of the maps that see it and their least
    relative std, both in percent, and their number."""
    total = np.zeros(len(xyz))
    views = np.zeros(len(xyz), np.float32)
    least = np.full(len(xyz), np.nan, np.float32)
    for refined in maps:
        local = transform(refined.rotation, refined.translation, xyz)
        pixels = project(refined.camera, local)
        rows = np.flatnonzero(inside(pixels, refined.camera.size) & (local[:, 2] > 0))
        rows = rows[sample_nearest(refined.valid, pixels[rows])]
        std = sample_nearest(refined.relative_std, pixels[rows])
        off = np.abs(sample_nearest(refined.depth, pixels[rows]) / local[rows, 2] - 1)
        agrees = off <= _SIGMAS * std
        rows, std, off = rows[agrees], std[agrees], off[agrees]
        total[rows] += off
        views[rows] += 1
        least[rows] = np.fmin(least[rows], std)
    error = (100 * total / np.maximum(views, 1)).astype(np.float32)
    return error, 100 * least, views
