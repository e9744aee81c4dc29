"""Robust similarity transform between two reconstructions with common images.

Each common image gives one hypothesis. The poses of the image in both reconstructions give rotation
and translation, and the ratio of its depth scales gives the scale, so one common image suffices. A
keypoint that observes a point in both reconstructions supports a hypothesis if the transformed
point projects close to the other point. The best hypothesis is refined by least squares.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.similarity import SimilarityTransform, umeyama
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

MAX_ERROR_PX = 8.0
"""Largest distance of the projections of a point of both reconstructions. [COLMAP
ReconstructionAligner max_reproj_error]"""
MIN_COMMON_POINTS = 30
"""Smallest number of common points that agree. [COLMAP abs_pose_min_num_inliers]"""
MAX_SAMPLED_OBSERVATIONS = 2048
"""Maximum number of common observations by which hypotheses are compared. [ours]"""
NUM_REFINEMENTS = 3
"""Number of least-squares refinements of the best hypothesis. [ours]"""


class Alignment(NamedTuple):
    """Similarity transform between two reconstructions, with its support."""

    a_from_b: SimilarityTransform
    num_points: int
    """Number of common observations whose points agree."""
    num_images: int
    """Number of common images in which most common observations agree."""
    num_common_images: int
    """Number of images with common observations."""

    @property
    def is_supported(self) -> bool:
        """True if most common images agree."""
        return 2 * self.num_images > self.num_common_images


class _CommonObservations(NamedTuple):
    """Keypoints that observe a point in both reconstructions."""

    image: Int64
    """(m,) row of the common image of each keypoint."""
    points_a: Float64
    """(m, 3) observed points of the first reconstruction."""
    points_b: Float64
    """(m, 3) observed points of the second reconstruction."""


def align_reconstructions(a: Reconstruction, b: Reconstruction) -> Alignment | None:
    """Estimate the similarity transform between two reconstructions from their common images.

    Args:
        a: First reconstruction.
        b: Second reconstruction, of the same mapping problem.

    Returns:
        The transform that most common observations support, or None without enough support.
    """
    images_b = {image.index: image for image in b.images}
    common = [(image, images_b[image.index]) for image in a.images if image.index in images_b]
    observations = _collect_observations(common, a, b)
    if len(observations.image) < MIN_COMMON_POINTS:
        return None
    images_a = [image for image, _ in common]
    hypotheses = [_transform_from_image(*pair) for pair in common]
    step = max(1, len(observations.image) // MAX_SAMPLED_OBSERVATIONS)
    image, points_a, points_b = observations
    sample = _CommonObservations(image[::step], points_a[::step], points_b[::step])
    support = [_find_inliers(images_a, sample, hypothesis).sum() for hypothesis in hypotheses]
    transform = hypotheses[int(np.argmax(support))]
    inliers = _find_inliers(images_a, observations, transform)
    for _ in range(NUM_REFINEMENTS):
        if inliers.sum() < MIN_COMMON_POINTS:
            return None
        refined = _fit(images_a, observations, inliers)
        refined_inliers = _find_inliers(images_a, observations, refined)
        if refined_inliers.sum() < inliers.sum():
            break
        transform, inliers = refined, refined_inliers
    counts = np.bincount(observations.image, minlength=len(common))
    agreeing = np.bincount(observations.image[inliers], minlength=len(common))
    return Alignment(
        transform,
        int(inliers.sum()),
        int(np.count_nonzero(2 * agreeing > counts)),
        int(np.count_nonzero(counts)),
    )


def find_agreeing(image: RegisteredImage, points_a: Float64, points_b: Float64) -> Bool:
    """Return a mask (m,) of the points of both reconstructions that project close to each other.

    Args:
        image: Image in whose pixels the distance is measured.
        points_a: (m, 3) points.
        points_b: (m, 3) points in the same frame.
    """
    rows = np.zeros(len(points_a), dtype=np.int64)
    identity = SimilarityTransform(1.0, np.eye(3), np.zeros(3))
    return _find_inliers([image], _CommonObservations(rows, points_a, points_b), identity)


def _collect_observations(
    common: list[tuple[RegisteredImage, RegisteredImage]], a: Reconstruction, b: Reconstruction
) -> _CommonObservations:
    rows, ids_a, ids_b = [], [], []
    for row, (image_a, image_b) in enumerate(common):
        seen = (image_a.point_ids >= 0) & (image_b.point_ids >= 0)
        rows.append(np.full(np.count_nonzero(seen), row))
        ids_a.append(image_a.point_ids[seen])
        ids_b.append(image_b.point_ids[seen])
    if not rows:
        return _CommonObservations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    return _CommonObservations(
        np.concatenate(rows), a.points[np.concatenate(ids_a)], b.points[np.concatenate(ids_b)]
    )


def _transform_from_image(a: RegisteredImage, b: RegisteredImage) -> SimilarityTransform:
    """Return the transform ``a_from_b`` from pose and depth scale of one common image."""
    scale = a.scale / b.scale
    rotation = a.rotation.T @ b.rotation
    center_a = camera_center(a.rotation, a.translation)
    center_b = camera_center(b.rotation, b.translation)
    return SimilarityTransform(scale, rotation, center_a - scale * rotation @ center_b)


def _find_inliers(
    images: list[RegisteredImage], observations: _CommonObservations, transform: SimilarityTransform
) -> Bool:
    """Return a mask (m,) of the observations whose points project close to each other."""
    pixels_a = _project(images, observations.image, observations.points_a)
    pixels_b = _project(images, observations.image, transform.apply(observations.points_b))
    with np.errstate(invalid="ignore"):
        inliers: Bool = np.linalg.norm(pixels_a - pixels_b, axis=1) <= MAX_ERROR_PX
    return inliers


def _project(images: list[RegisteredImage], rows: Int64, points: Float64) -> Float64:
    """Project points (m, 3) into their images, with NaN for points behind the camera."""
    rotations = np.array([image.rotation for image in images])[rows]
    translations = np.array([image.translation for image in images])[rows]
    params = np.array([image.camera.params for image in images])[rows]
    local = np.einsum("mij,mj->mi", rotations, points) + translations
    z = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    pixels: Float64 = params[:, :2] * local[:, :2] / z + params[:, 2:]
    return pixels


def _fit(
    images: list[RegisteredImage], observations: _CommonObservations, inliers: Bool
) -> SimilarityTransform:
    """Fit the transform to common points, weighted by the inverse of their squared depth."""
    rows, points = observations.image[inliers], observations.points_a[inliers]
    axes = np.array([image.rotation[2] for image in images])[rows]
    offsets = np.array([image.translation[2] for image in images])[rows]
    depth = (axes * points).sum(axis=1) + offsets
    return umeyama(observations.points_b[inliers], points, 1 / depth**2)
