"""Selection of source views for stereo by common visible surface and triangulation angle."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Int64
from mpsfm_core.geometry import camera_center, pixel_centers, sample_nearest, unproject
from mpsfm_core.geometry.frustum import frustum_planes
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.support.jit import kernel
from mpsfm_core.support.threads import parallel_map

_GRID_ROWS = 16
"""Number of rows of the pixel grid on which the overlap of views is measured."""
_FULL_SCORE_DEG, _WIDE_DEG = 8.0, 15.0
"""Minimum and maximum triangulation angle in degrees with the maximum view score [ours].

The view selection score of MVSNet has its maximum at 5 degrees."""
_MIN_GAIN = 0.02
"""Minimum mean increase of the score per pixel by an additional source view [ours]."""
_OCCLUSION_STDS = 1.5
"""Minimum distance of an occluded point behind the visible surface, in stds of log depth [ours]."""


class _DepthGrids(NamedTuple):
    """Poses and depth maps of m views, sampled on coarse pixel grids."""

    params: Float64
    """(m, 4) intrinsics (fx, fy, cx, cy) in pixels of the coarse grids."""
    columns: Int64
    """(m,) number of columns of each view's pixel grid."""
    rotations: Float64
    """(m, 3, 3) rotations of ``cam_from_world``."""
    translations: Float64
    """(m, 3) translations of ``cam_from_world``."""
    centers: Float64
    """(m, 3) camera centers, world frame."""
    log_depth: Float64
    """(m, rows, max columns) natural log of depth at the pixels of the coarse grids."""
    log_std: Float64
    """(m,) median std of log depth of each view."""


class _SampledViews(NamedTuple):
    """Depth grids of m views, with the world points of their pixels and the view frusta."""

    grids: _DepthGrids
    points: list[Float64]
    """(n, 3) world points of the grid pixels of each view."""
    frusta: Float64
    """(m, 5, 4) planes of the view frusta, world frame."""
    max_log_depth: Float64
    """(m,) natural log of the largest depth of each view."""


def select_source_views(images: Sequence[RegisteredImage], max_sources: int) -> list[list[int]]:
    """Select up to `max_sources` source views for each image, the most useful first.

    Each step of the greedy selection adds the view with the largest score increase. Pixels that
    already selected views cover have a lower weight in the score.
    """
    if not images:
        return []
    views = _sample_views(images)
    return parallel_map(lambda row: _select_sources(views, row, max_sources), range(len(images)))


def _sample_views(images: Sequence[RegisteredImage]) -> _SampledViews:
    """Sample pose, depth and points of each image on a coarse grid."""
    ratios = [image.camera.width / image.camera.height for image in images]
    columns = np.array([max(2, round(_GRID_ROWS * ratio)) for ratio in ratios])
    cameras = [
        image.camera.resized(int(width), _GRID_ROWS)
        for image, width in zip(images, columns, strict=True)
    ]
    rotations = np.stack([image.rotation for image in images])
    translations = np.stack([image.translation for image in images])
    centers = camera_center(rotations, translations)
    log_depth = np.full((len(images), _GRID_ROWS, columns.max()), -np.inf)
    log_std = np.ones(len(images))
    points = []
    for row, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        xy = pixel_centers(camera.width, camera.height).reshape(-1, 2)
        map_xy = xy * (np.array(image.depth.shape[::-1]) / camera.size)
        depth = sample_nearest(image.depth.depth, map_xy).astype(np.float64)
        valid = sample_nearest(image.depth.valid, map_xy)
        depth = np.where(valid, depth, np.median(depth[valid]) if valid.any() else 1.0)
        variance = image.depth.variance
        assert variance is not None  # The mapper's refined depth maps always have a variance.
        if valid.any():
            relative_std = np.sqrt(sample_nearest(variance, map_xy)) / depth
            log_std[row] = np.median(relative_std[valid])
        log_depth[row, :, : camera.width] = np.log(depth).reshape(_GRID_ROWS, -1)
        points.append(unproject(camera, xy, depth) @ image.rotation + centers[row])
    params = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras])
    sizes = np.array([c.size for c in cameras], np.float64)
    frusta = frustum_planes(rotations, translations, params, sizes)
    grids = _DepthGrids(params, columns, rotations, translations, centers, log_depth, log_std)
    return _SampledViews(grids, points, frusta, log_depth.max(axis=(1, 2)))


def _select_sources(views: _SampledViews, row: int, max_sources: int) -> list[int]:
    """Select the source views of one image greedily."""
    sources = _find_overlapping_views(views, row)
    scores = np.zeros((len(sources), len(views.points[row])))
    _score_points(row, sources, views.points[row], views.grids, scores)
    useful = scores.mean(axis=1) >= _MIN_GAIN  # Gains only decrease during the selection.
    sources, scores = sources[useful], scores[useful]
    selected: list[int] = []
    covered = np.zeros(scores.shape[1])
    for _ in range(min(max_sources, len(sources))):
        gain = (scores / (1 + covered)).mean(axis=1)
        gain[selected] = 0
        best = int(gain.argmax())
        if gain[best] < _MIN_GAIN:
            break
        selected.append(best)
        covered += scores[best]
    return [int(sources[best]) for best in selected]


def _find_overlapping_views(views: _SampledViews, row: int) -> Int64:
    """Return the other views (k,) that may see points of a view, by their frusta.

    A view cannot see the points if its frustum does not intersect their bounding sphere. The
    frustum ends at the largest depth of the view, because points behind this depth are occluded.
    """
    points = views.points[row]
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - center, axis=1).max()
    distances = views.frusta @ np.append(center, 1.0)
    max_behind = _OCCLUSION_STDS * np.maximum(views.grids.log_std[row], views.grids.log_std)
    max_depth = np.exp(views.max_log_depth + max_behind)
    overlaps = (distances >= -radius).all(axis=1) & (distances[:, 0] <= max_depth + radius)
    overlaps[row] = False
    return np.flatnonzero(overlaps)


@kernel()
def _score_points(
    reference: int, sources: Int64, points: Float64, grids: _DepthGrids, scores: Float64
) -> None:
    """Compute a score in [0, 1] of source views for stereo at each point of the reference view.

    The view score is the product of a term for the triangulation angle and a term for the ratio of
    distances. Occluded points have the score 0.

    `points` are the (n, 3) world points of the view `reference`. The array `scores` (k, n) of the k
    `sources` is the output.
    """
    params, columns, rotations, translations, centers, log_depth, log_std = grids
    rows = log_depth.shape[1]
    for index, source in enumerate(sources):
        fx, fy, cx, cy = params[source]
        rotation, translation = rotations[source], translations[source]
        max_behind = _OCCLUSION_STDS * max(log_std[reference], log_std[source])
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
            if u < 0 or v < 0 or u > columns[source] or v > rows:
                continue
            column, row = min(int(u), columns[source] - 1), min(int(v), rows - 1)
            if math.log(z) - log_depth[source, row, column] >= max_behind:
                continue
            # Squared distances to both camera centers, and the dot product of both rays.
            d1, d2, dot = 0.0, 0.0, 0.0
            for axis in range(3):
                a, b = point[axis] - centers[reference, axis], point[axis] - centers[source, axis]
                d1, d2, dot = d1 + a * a, d2 + b * b, dot + a * b
            if dot <= 0:
                continue
            angle = math.degrees(math.acos(min(dot / math.sqrt(d1 * d2), 1.0)))
            excess = max(angle - _WIDE_DEG, 0.0) / _WIDE_DEG
            distance_ratio = math.sqrt(min(d1, d2) / max(d1, d2))
            angle_score = min(angle / _FULL_SCORE_DEG, 1.0) * math.exp(-(excess**2) / 2)
            scores[index, k] = angle_score * distance_ratio
