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
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, MappingImage, MappingProblem, VerifiedPair
from mpsfm_core.geometry import (
    pixel_centers,
    project,
    sample_bilinear,
    scale_pixels,
    transform,
    unproject,
)
from mpsfm_core.mapping.consistency.depth_consistency import count_visible_points
from mpsfm_core.mapping.refinement.depth_noise import CELLS
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

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


def score_reconstruction(model: Reconstruction, problem: MappingProblem) -> ReconstructionScore:
    """Compute the log likelihood ratio of the matches and depth maps of a reconstruction."""
    images = {image.index: image for image in model.images if image.confirmed}
    matches = 0.0
    for pair in problem.pairs_between_frames():
        if pair.image_a in images and pair.image_b in images:
            matches += score_pair(images[pair.image_a], images[pair.image_b], pair, problem)
    depth = float(sum(_score_depth(list(images.values()))))
    return ReconstructionScore(matches, depth)


def score_pair(
    a: RegisteredImage, b: RegisteredImage, pair: VerifiedPair, problem: MappingProblem
) -> float:
    """Compute the log likelihood ratio of the matches of two registered images."""
    given_a, given_b = problem.images[pair.image_a], problem.images[pair.image_b]
    xy_a, xy_b = given_a.keypoints[pair.matches[:, 0]], given_b.keypoints[pair.matches[:, 1]]
    forward, best_forward = _compare_projections(a, b, xy_a, xy_b, given_a)
    backward, best_backward = _compare_projections(b, a, xy_b, xy_a, given_b)
    losses = (best_forward - forward + best_backward - backward) / 2
    loss = float(losses @ pair.scores) / max(float(pair.scores.sum()), 1e-12)
    connects = math.log(1 - FALSE_PAIR_RATIO) + OCCAM_FACTOR - NUM_INDEPENDENT * loss
    return float(np.logaddexp(connects, math.log(FALSE_PAIR_RATIO)))


def _compare_projections(
    source: RegisteredImage,
    target: RegisteredImage,
    xy: Float64,
    target_xy: Float64,
    given: MappingImage,
) -> tuple[Float64, Float64]:
    """Compare keypoints (m, 2) with the projections of their matched keypoints.

    Returns:
        Log likelihood ratios (m,) of the keypoint errors and of errors of zero.
    """
    size = given.camera.size
    depth, log_std, known = _sample_depth(source.depth, xy, size)
    points = unproject(source.camera, xy, np.where(known, depth, 1.0))
    rotation = target.rotation @ source.rotation.T
    local = transform(rotation, target.translation - rotation @ source.translation, points)
    z = np.maximum(local[:, 2], 1e-9)
    projected = project(target.camera, np.where(local[:, 2:] > 1e-9, local, [0.0, 0.0, 1.0]))
    change = points @ rotation.T
    slope = change[:, :2] / z[:, None] - local[:, :2] * (change[:, 2] / z**2)[:, None]
    slope *= [target.camera.fx, target.camera.fy]
    length = np.maximum(np.linalg.norm(slope, axis=1), 1e-9)
    error, direction = target_xy - projected, slope / length[:, None]
    along = (error * direction).sum(axis=1)
    across = error[:, 0] * direction[:, 1] - error[:, 1] * direction[:, 0]
    log_std = np.maximum(log_std, MIN_DEPTH_STD)
    std = np.hypot(KEYPOINT_STD_PX, log_std * length)
    # the expected error must not grow without bound as a wrong pose moves a point to the camera
    best_std = np.minimum(std, np.hypot(KEYPOINT_STD_PX, log_std * target.camera.fx))
    area, diagonal = float(size[0] * size[1]), float(np.hypot(*size))
    scale = area / (np.pi * KEYPOINT_STD_PX)
    best = scale * np.where(known, 1 / (np.pi * best_std), 1 / diagonal)
    density = scale * np.where(known, 1 / (np.pi * std * (1 + (along / std) ** 2)), 1 / diagonal)
    density /= 1 + (across / KEYPOINT_STD_PX) ** 2
    density = np.where(local[:, 2] > 1e-9, density, 0.0)
    outlier = 1 - INLIER_RATIO
    return np.log(INLIER_RATIO * density + outlier), np.log(INLIER_RATIO * best + outlier)


def _sample_depth(
    depth: DepthPrior, xy: Float64, size: tuple[int, int]
) -> tuple[Float64, Float64, Bool]:
    """Return depth (m,), its log std (m,) and a mask (m,) of known depth at keypoints (m, 2)."""
    assert depth.variance is not None  # all refined depth maps contain a variance of depth
    at = scale_pixels(xy, size, (depth.shape[1], depth.shape[0]))
    z, known = sample_bilinear(depth.depth, depth.valid, at)
    variance, _ = sample_bilinear(depth.variance, depth.valid, at)
    return z, np.sqrt(np.maximum(variance, 0)) / np.maximum(z, 1e-12), known


def _score_depth(images: Sequence[RegisteredImage]) -> Iterator[float]:
    """Yield the log likelihood ratio of the depth of each ordered pair of overlapping images."""
    rotations = np.array([image.rotation for image in images]).reshape(-1, 3, 3)
    translations = np.array([image.translation for image in images]).reshape(-1, 3)
    intrinsics = np.array([image.camera.params for image in images]).reshape(-1, 4)
    sizes = np.array([image.camera.size for image in images], np.float64).reshape(-1, 2)
    for row, image in enumerate(images):
        points, log_std = _sample_points(image)
        counts = count_visible_points(points, rotations, translations, intrinsics, sizes)
        for other in map(int, np.flatnonzero(counts)):
            if other != row:
                ratios = _compare_depth(points, log_std, images[other])
                yield NUM_INDEPENDENT / GRID**2 * float(ratios.sum())


def _sample_points(image: RegisteredImage) -> tuple[Float64, Float64]:
    """Return the world points (n, 3) of a depth map, and the standard deviation of log depth."""
    depth = image.depth
    rows, columns = depth.shape
    xy = pixel_centers(GRID, GRID).reshape(-1, 2) * [columns, rows] / GRID
    column, row = np.floor(xy).astype(np.int64).T
    known = depth.valid[row, column]
    z = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None  # all refined depth maps contain a variance of depth
    log_std = np.sqrt(depth.variance[row, column]) / np.where(known, z, 1.0)
    points = unproject(image.camera.resized(columns, rows), xy[known], z[known])
    return (points - image.translation) @ image.rotation, log_std[known]


def _compare_depth(points: Float64, log_std: Float64, image: RegisteredImage) -> Float64:
    """Return the log likelihood ratios of the world points that project into an image."""
    depth = image.depth
    rows, columns = depth.shape
    local = transform(image.rotation, image.translation, points)
    in_front = local[:, 2] > 1e-9
    local, log_std = local[in_front], log_std[in_front]
    xy = project(image.camera.resized(columns, rows), local)
    column, row = np.floor(xy).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    inside[inside] = depth.valid[row[inside], column[inside]]
    column, row, z, log_std = column[inside], row[inside], local[inside, 2], log_std[inside]
    surface = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None
    std = np.hypot(log_std, np.sqrt(depth.variance[row, column]) / surface)
    std = np.maximum(std, MIN_DEPTH_STD)
    behind = np.log(z / surface)
    agrees, occluded, seen_through = DEPTH_OUTCOMES
    density = agrees / (np.pi * std * (1 + (behind / std) ** 2))
    density += np.where(behind > 0, occluded, seen_through) / (DEPTH_RANGE / 2)
    ratios: Float64 = np.log(DEPTH_RANGE * density)
    return ratios
