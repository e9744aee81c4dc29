"""Score of a reconstruction, for the comparison of reconstructions of the same images.

The score is a log likelihood ratio. It is additive over image pairs, so a change of one image
changes only the terms of its pairs. The reference is a reconstruction without images, in which a
match and a depth are random. An image that is left out therefore adds nothing.

* **Matches.** The keypoint of an image, at the depth of its depth map, projects into the other
  image. The distance between the matched keypoint and this projection has a Cauchy distribution,
  with the std of the keypoint across the epipolar line, and the std of the depth along the line.
  Outliers are uniform in the image. A pair either connects its images or shows two similar places,
  whose matches one wrong relative pose explains, however many there are. The first case gains
  ``OCCAM_FACTOR`` and loses the mean log likelihood ratio between perfect and observed matches,
  times ``NUM_INDEPENDENT``. The mixture of both cases bounds the cost of a contradicted pair.

* **Depth.** The pixels of a depth map project into the other image, where their depth agrees, is
  occluded, or is in front of the surface (the other image sees through the surface). The log
  depth difference has a mixture density of a Cauchy distribution with the std of both depths, and
  of uniform distributions in front and behind. The reference is uniform.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera
from mpsfm_core.geometry import pixel_centers, project, transform, unproject
from mpsfm_core.mapping.consistency.visibility import Views, measure_visibility
from mpsfm_core.mapping.refinement.depth_noise import CELLS
from mpsfm_core.mapping.scene.depth_map import DepthMap
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, subsample_camera

INLIER_RATIO = 0.9
"""Prior probability that a verified match of a correct pair is an inlier. [ours]"""
KEYPOINT_STD_PX = 2.0
"""Scale of the Cauchy distribution of keypoint errors in pixels, which includes errors of poses.
[ours]"""
MIN_DEPTH_STD = 0.02
"""Smallest standard deviation of log depth, which includes errors of poses. [ours]"""
NUM_INDEPENDENT = CELLS**2
"""Effective number of independent matches of a pair, and of independent depths of a map, because
errors in the same cell of an image are correlated."""
FALSE_PAIR_RATIO = 0.1
"""Prior probability that a verified pair shows two similar places. [ours]"""
OCCAM_FACTOR = 6 * math.log(1000)
"""Log ratio of the prior range and the precision of a relative pose, which has six degrees of
freedom. [ours]"""
GRID = 24
"""Columns and rows of the pixel grid whose depth is compared with other images. [ours]"""
MAP_WIDTH = 160
"""Width in pixels to which depth maps are subsampled. [ours]"""
DEPTH_RANGE = 4.0
"""Range of the log depth of the reference. [ours]"""
DEPTH_OUTCOMES = (0.70, 0.25, 0.05)
"""Prior probabilities that the depth of a pixel agrees, is occluded, and is seen through. [ours]"""


class ReconstructionScore(NamedTuple):
    """Log likelihood ratio of a reconstruction, with its terms."""

    matches: float
    """Sum over the pairs of matched images."""
    depth: float
    """Sum over the ordered pairs of overlapping images."""

    @property
    def total(self) -> float:
        """Log likelihood ratio of matches and depth."""
        return self.matches + self.depth


class PairScores(NamedTuple):
    """Log likelihood ratios of the matches of registered images, each pair once."""

    a: Int64
    """(p,) index of the first image of each pair."""
    b: Int64
    """(p,) index of the second image of each pair, larger than ``a``."""
    score: Float64
    """(p,) log likelihood ratio."""


def score_reconstruction(model: Reconstruction, scene: Scene) -> ReconstructionScore:
    """Compute the log likelihood ratio of the matches and depth maps of a reconstruction.

    Args:
        model: The reconstruction.
        scene: Scene of its mapping problem without registered images, which is left unchanged.
    """
    empty = scene.snapshot()
    confirmed = tuple(image for image in model.images if image.confirmed)
    scene.resume(replace(model, images=confirmed), refined_map_width=MAP_WIDTH)
    score = score_scene(scene)
    scene.restore(empty)
    return score


def score_scene(scene: Scene) -> ReconstructionScore:
    """Compute the log likelihood ratio of the matches and depth maps of registered images."""
    matches, depth = score_pairs(scene).score.sum(), sum(_score_depth(scene))
    return ReconstructionScore(float(matches), float(depth))


def score_pairs(scene: Scene) -> PairScores:
    """Compute the log likelihood ratio of the matches of each two registered images.

    Images of the same frame are not compared.
    """
    graph, registered, frame_of = scene.graph, scene.registered, scene.rigs.frame_of
    a, b = graph.image_of[graph.source], graph.image_of[graph.target]
    edges = np.flatnonzero(registered[a] & registered[b] & (frame_of[a] != frame_of[b]))
    a, b, num_images = a[edges], b[edges], scene.num_images
    keys = np.minimum(a, b) * num_images + np.maximum(a, b)
    keys, pair_of = np.unique(keys, return_inverse=True)
    loss = np.zeros(len(keys))
    np.add.at(loss, pair_of, graph.score[edges] * _compute_losses(scene, edges))
    loss /= np.bincount(pair_of, graph.score[edges], len(keys))
    connects = math.log(1 - FALSE_PAIR_RATIO) + OCCAM_FACTOR - NUM_INDEPENDENT * loss
    score = np.logaddexp(connects, math.log(FALSE_PAIR_RATIO))
    return PairScores(keys // num_images, keys % num_images, score)


def _compute_losses(scene: Scene, edges: Int64) -> Float64:
    """Compare the projections of keypoints with their matched keypoints.

    Args:
        scene: The scene.
        edges: (m,) matches in the correspondence graph.

    Returns:
        (m,) log likelihood ratios of errors of zero, minus those of the observed errors.
    """
    source, target = scene.graph.source[edges], scene.graph.target[edges]
    a, b = scene.graph.image_of[source], scene.graph.image_of[target]
    depth, known = scene.depth_at(source)
    points = scene.rays(source) * np.where(known, depth, 1.0)[:, None]
    rotations = scene.rotations[b] @ scene.rotations[a].swapaxes(1, 2)
    change = np.einsum("nij,nj->ni", rotations, points)
    local = change + scene.translations[b]
    local -= np.einsum("nij,nj->ni", rotations, scene.translations[a])
    in_front = local[:, 2] > 1e-9
    z = np.where(in_front, local[:, 2], 1.0)
    focal_px = scene.intrinsics[b, :2]
    projected = focal_px * local[:, :2] / z[:, None] + scene.intrinsics[b, 2:]
    # derivative of the projection by log depth
    slope = focal_px * (change[:, :2] - local[:, :2] * (change[:, 2] / z)[:, None]) / z[:, None]
    length = np.maximum(np.linalg.norm(slope, axis=1), 1e-9)
    error, direction = scene.keypoints[target] - projected, slope / length[:, None]
    along = (error * direction).sum(axis=1)
    across = error[:, 0] * direction[:, 1] - error[:, 1] * direction[:, 0]
    log_std = np.maximum(scene.keypoint_log_std[source], MIN_DEPTH_STD)
    std = np.hypot(KEYPOINT_STD_PX, log_std * length)
    # the expected error must not grow without bound as a wrong pose moves a point to the camera
    best_std = np.minimum(std, np.hypot(KEYPOINT_STD_PX, log_std * focal_px[:, 0]))
    width, height = scene.image_sizes[b].T
    scale = width * height / (np.pi * KEYPOINT_STD_PX)
    uniform = 1 / np.hypot(width, height)
    best = scale * np.where(known, 1 / (np.pi * best_std), uniform)
    density = scale * np.where(known, 1 / (np.pi * std * (1 + (along / std) ** 2)), uniform)
    density = np.where(in_front, density / (1 + (across / KEYPOINT_STD_PX) ** 2), 0.0)
    outlier = 1 - INLIER_RATIO
    losses: Float64 = np.log(INLIER_RATIO * best + outlier)
    losses -= np.log(INLIER_RATIO * density + outlier)
    return losses


class _DepthGrid(NamedTuple):
    """Subsampled depth map of one image."""

    depth: Float32
    """(h, w) depth in world units."""
    log_std: Float32
    """(h, w) standard deviation of the log depth."""
    valid: Bool
    """(h, w) bool mask of the pixels with known depth."""
    camera: PinholeCamera
    """Intrinsics in pixels of the grid."""


def _make_grid(depth_map: DepthMap) -> _DepthGrid:
    step = compute_subsampling_step(depth_map.valid.shape[1], MAP_WIDTH)
    return _DepthGrid(
        subsample(depth_map.depth, step),
        subsample(depth_map.log_std, step),
        subsample(depth_map.valid, step),
        subsample_camera(depth_map.camera, step),
    )


def _score_depth(scene: Scene) -> Iterator[float]:
    """Yield the log likelihood ratio of the depth of each ordered pair of overlapping images."""
    registered = scene.registered_images().tolist()
    images = np.array([i for i in registered if scene.maps[i].active], dtype=np.int64)
    grids = [_make_grid(scene.maps[image]) for image in images.tolist()]
    views = Views.of_scene(scene, images)
    rotations, translations = views.rotations, views.translations
    for row, grid in enumerate(grids):
        local, log_std = _sample_points(grid)
        points = (local - translations[row]) @ rotations[row]
        depths = np.ascontiguousarray(local[:, 2])  # kernels compile again for other layouts
        counts, _ = measure_visibility(points, depths, views, num_best=len(images), min_count=1)
        for other in map(int, np.flatnonzero(counts)):
            if other != row:
                seen = transform(rotations[other], translations[other], points)
                ratios = _compare_depth(seen, log_std, grids[other])
                yield NUM_INDEPENDENT / GRID**2 * float(ratios.sum())


def _sample_points(grid: _DepthGrid) -> tuple[Float64, Float64]:
    """Return points (n, 3) of a depth map in the camera frame, and their std (n,) of log depth."""
    rows, columns = grid.depth.shape
    xy = pixel_centers(GRID, GRID).reshape(-1, 2) * [columns, rows] / GRID
    column, row = np.floor(xy).astype(np.int64).T
    known = grid.valid[row, column]
    z = grid.depth[row, column].astype(np.float64)
    points = unproject(grid.camera, xy[known], z[known])
    return points, grid.log_std[row, column][known].astype(np.float64)


def _compare_depth(points: Float64, log_std: Float64, grid: _DepthGrid) -> Float64:
    """Return the log likelihood ratios of points (n, 3) that a camera sees, in its frame."""
    rows, columns = grid.depth.shape
    in_front = points[:, 2] > 1e-9
    points, log_std = points[in_front], log_std[in_front]
    column, row = np.floor(project(grid.camera, points)).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    inside[inside] = grid.valid[row[inside], column[inside]]
    column, row, z, log_std = column[inside], row[inside], points[inside, 2], log_std[inside]
    std = np.maximum(np.hypot(log_std, grid.log_std[row, column]), MIN_DEPTH_STD)
    behind = np.log(z / grid.depth[row, column])
    agrees, occluded, seen_through = DEPTH_OUTCOMES
    density = agrees / (np.pi * std * (1 + (behind / std) ** 2))
    density += np.where(behind > 0, occluded, seen_through) / (DEPTH_RANGE / 2)
    ratios: Float64 = np.log(DEPTH_RANGE * density)
    return ratios
