"""Measure the evidence for a reconstruction: explained matches, parallax and connectivity.

The evidence is written into ``summary.json`` and judged by :mod:`mpsfm_core.report.verdict`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Float64, Int64, MappingProblem
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.scene.reconstruction import (
    Reconstruction,
    RegisteredImage,
    find_explained_matches,
)

MIN_SHARED_POINTS = 3
"""Minimum number of common 3D points of connected images [minimal sample of PnP]."""


def count_explained_matches(
    reconstruction: Reconstruction, problem: MappingProblem
) -> dict[tuple[str, str], int]:
    """Count the matches of each registered image pair whose keypoints share a 3D point.

    Args:
        reconstruction: reconstruction of some images of the mapping problem.
        problem: mapping problem with images and verified pairs.

    Returns:
        Number of explained matches by pair of image names.
    """
    images = problem.images
    return {
        (images[pair.image_a].name, images[pair.image_b].name): int(mask.sum())
        for pair, mask in find_explained_matches(reconstruction.confirmed_images, problem)
    }


def describe_evidence(reconstruction: Reconstruction, problem: MappingProblem) -> dict[str, Any]:
    """Describe the evidence for the poses of a reconstruction as plain data.

    Args:
        reconstruction: reconstruction of some images of the mapping problem.
        problem: mapping problem with images and verified pairs.

    Returns:
        Plain data with the keys ``parts``, ``median_angle_deg`` and ``images``. ``parts`` are the
        image names of each connected part of the covisibility graph, largest part first.
        ``median_angle_deg`` is the median over the 3D points of the maximum triangulation angle.
        ``images`` are the number of 3D points, the share of explained matches and the predicted
        relative pose error (None without a prediction), by image name.
    """
    images = reconstruction.confirmed_images
    explained = count_explained_matches(reconstruction, problem)
    matched = _count_per_image(
        {
            (problem.images[pair.image_a].name, problem.images[pair.image_b].name): len(pair)
            for pair in problem.pairs
        },
        explained.keys(),
    )
    supported = _count_per_image(explained, explained.keys())
    return {
        "parts": _connected_parts(images, len(reconstruction.points)),
        "median_angle_deg": _median_angle_deg(images, reconstruction.points),
        "images": {
            image.name: {
                "points": int((image.point_ids >= 0).sum()),
                "explained_ratio": round(
                    supported.get(image.name, 0) / max(matched.get(image.name, 0), 1), 4
                ),
                "pose_error_deg": None
                if image.pose_error_deg is None
                else round(image.pose_error_deg, 3),
            }
            for image in images
        },
    }


def _count_per_image(counts: dict[tuple[str, str], int], pairs: Any) -> dict[str, int]:
    """Sum the counts of image pairs over the pairs of each image."""
    sums: dict[str, int] = {}
    for names in pairs:
        for name in names:
            sums[name] = sums.get(name, 0) + counts[names]
    return sums


def _rows(image: RegisteredImage) -> Int64:
    """Return the ids of the 3D points that an image observes."""
    return np.unique(image.point_ids[image.point_ids >= 0])


def _connected_parts(images: tuple[RegisteredImage, ...], num_points: int) -> list[list[str]]:
    """Return the connected components of the covisibility graph, largest component first."""
    if not images:
        return []
    rows = [_rows(image) for image in images]
    observations = coo_array(
        (
            np.ones(sum(map(len, rows))),
            (np.repeat(np.arange(len(images)), list(map(len, rows))), np.concatenate(rows)),
        ),
        shape=(len(images), max(num_points, 1)),
    ).tocsr()
    shared = (observations @ observations.T) >= MIN_SHARED_POINTS
    _, labels = connected_components(shared, directed=False)
    parts = [
        [image.name for image, label in zip(images, labels, strict=True) if label == part]
        for part in range(labels.max() + 1)
    ]
    return sorted(parts, key=len, reverse=True)


def _median_angle_deg(images: tuple[RegisteredImage, ...], points: Float64) -> float | None:
    """Return the median over the 3D points of the maximum triangulation angle in degrees."""
    if not len(points) or not images:
        return None
    mean_rays = np.zeros_like(points)
    rays = []
    for image in images:
        rows = _rows(image)
        ray = points[rows] - camera_center(image.rotation, image.translation)
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        mean_rays[rows] += ray
        rays.append((rows, ray))
    mean_rays /= np.maximum(np.linalg.norm(mean_rays, axis=1, keepdims=True), 1e-12)
    # Twice the largest angle to the mean ray bounds the largest angle between two rays.
    cosines = np.ones(len(points))
    for rows, ray in rays:
        cosines[rows] = np.minimum(cosines[rows], (ray * mean_rays[rows]).sum(axis=1))
    angles = 2 * np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return round(float(np.median(angles)), 4)
