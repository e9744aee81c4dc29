"""Which views a photo is matched with: those that see the same surface at a good angle."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Int64
from mpsfm_core.geometry import camera_center, pixel_centers, sample_nearest, unproject
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.support.jit import kernel

_ROWS = 16
"""Of the grid of pixels that overlap is measured on."""
_ENOUGH_DEG, _WIDE_DEG = 8.0, 15.0
"""Parallax that is enough, and above which windows begin to look different; MVSNet's score has 5
degrees and spreads of 1 below and 10 above."""
_MIN_GAIN = 0.02
"""Mean gain a pixel, below which a view adds nothing (ours)."""
_HIDDEN_STDS = 1.5
"""A point so far behind what a view sees is hidden there, in std of depth (ours)."""


class _SampledViews(NamedTuple):
    """What is looked at of m views: a grid of pixels of each, of ``columns`` (m,) columns.

    ``params`` (m, 4): fx, fy, cx, cy of the grids. ``log_depth`` (m, rows, most columns),
    ``log_std`` (m,). ``points``: of each view its own (n, 3), world.
    """

    params: Float64
    columns: Int64
    rotations: Float64
    translations: Float64
    centers: Float64
    log_depth: Float64
    log_std: Float64
    points: list[Float64]


def select_source_views(images: Sequence[RegisteredImage], limit: int) -> list[list[int]]:
    """For each image the positions of at most ``limit`` others, the most useful first.

    Taken one after the other: each by what it adds where others see little.
    """
    if not images:
        return []
    views = _sample(images)
    return [_sources(views, row, limit) for row in range(len(images))]


def _sample(images: Sequence[RegisteredImage]) -> _SampledViews:
    ratios = [image.camera.width / image.camera.height for image in images]
    columns = np.array([max(2, round(_ROWS * ratio)) for ratio in ratios])
    cameras = [
        image.camera.resized(int(width), _ROWS)
        for image, width in zip(images, columns, strict=True)
    ]
    rotations = np.stack([image.rotation for image in images])
    translations = np.stack([image.translation for image in images])
    centers = camera_center(rotations, translations)
    log_depth = np.zeros((len(images), _ROWS, columns.max()))
    log_std = np.ones(len(images))
    points = []
    for row, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        xy = pixel_centers(camera.width, camera.height).reshape(-1, 2)
        on_map = xy * (np.array(image.depth.shape[::-1]) / camera.size)
        depth = sample_nearest(image.depth.depth, on_map).astype(np.float64)
        valid = sample_nearest(image.depth.valid, on_map)
        depth = np.where(valid, depth, np.median(depth[valid]) if valid.any() else 1.0)
        variance = image.depth.variance
        assert variance is not None  # of a refined map always
        if valid.any():
            spread = np.sqrt(sample_nearest(variance, on_map)) / depth
            log_std[row] = np.median(spread[valid])
        log_depth[row, :, : camera.width] = np.log(depth).reshape(_ROWS, -1)
        points.append(unproject(camera, xy, depth) @ image.rotation + centers[row])
    params = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras])
    return _SampledViews(
        params, columns, rotations, translations, centers, log_depth, log_std, points
    )


def _sources(views: _SampledViews, row: int, limit: int) -> list[int]:
    gains = np.zeros((len(views.points), len(views.points[row])))
    _gains(row, views.points[row], *views[:-1], gains)
    chosen: list[int] = []
    have = np.zeros(gains.shape[1])
    for _ in range(min(limit, len(gains) - 1)):
        added = (gains / (1 + have)).mean(axis=1)
        added[chosen] = 0
        best = int(added.argmax())
        if added[best] < _MIN_GAIN:
            break
        chosen.append(best)
        have += gains[best]
    return chosen


@kernel()
def _gains(
    own: int,
    points: Float64,
    params: Float64,
    columns: Int64,
    rotations: Float64,
    translations: Float64,
    centers: Float64,
    log_depth: Float64,
    log_std: Float64,
    gains: Float64,
) -> None:
    """What each other view says about each of our points, 0 to 1: (m, n)."""
    rows = log_depth.shape[1]
    for other in range(len(params)):
        if other == own:
            continue
        fx, fy, cx, cy = params[other]
        rotation, translation = rotations[other], translations[other]
        hidden = _HIDDEN_STDS * max(log_std[own], log_std[other])
        for k in range(len(points)):
            point = points[k]
            x, y, z = translation
            for axis in range(3):
                x += rotation[0, axis] * point[axis]
                y += rotation[1, axis] * point[axis]
                z += rotation[2, axis] * point[axis]
            if z <= 0:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            if u < 0 or v < 0 or u > columns[other] or v > rows:
                continue
            column, row = min(int(u), columns[other] - 1), min(int(v), rows - 1)
            if math.log(z) - log_depth[other, row, column] >= hidden:
                continue
            ours, theirs, cosine = 0.0, 0.0, 0.0
            for axis in range(3):
                a, b = point[axis] - centers[own, axis], point[axis] - centers[other, axis]
                ours, theirs, cosine = ours + a * a, theirs + b * b, cosine + a * b
            if cosine <= 0:
                continue
            lengths = math.sqrt(ours * theirs)
            angle = math.degrees(math.acos(min(cosine / lengths, 1.0)))
            wide = max(angle - _WIDE_DEG, 0.0) / _WIDE_DEG
            nearer = math.sqrt(min(ours, theirs) / max(ours, theirs))
            gains[other, k] = min(angle / _ENOUGH_DEG, 1.0) * math.exp(-(wide**2) / 2) * nearer
