"""Detection of duplicate images: copies, exposure brackets and frames of a camera at rest.

A duplicate adds no parallax, so duplicates are found before features are extracted. Candidates are
images whose thumbnails correlate. Patch alignment then measures the displacement of corners between
the two images, which is zero for duplicates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Float32, Float64, Int64, PinholeCamera, UInt8
from mpsfm_core.extraction.cache import content_key
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.matching.keypoint_adjustment import (
    PairSide,
    align_pair,
    smooth_gray_image,
)
from mpsfm_core.providers.source_hash import hash_module

MIN_CORRELATION = 0.7
"""Minimum correlation of the thumbnails of two duplicates. The measured correlation is at least
0.76 for edited copies, and up to 0.92 for different views, which patch alignment rejects. [ours]"""
MIN_ALIGNED_RATIO = 0.5
"""Minimum ratio of the corners that patch alignment finds at the same pixels of two duplicates. The
measured ratio is 0.6 to 1 for edited copies, and at most 0.01 for different views. [ours]"""
MAX_SHIFT_PX = 1.0
"""Maximum displacement in pixels of a corner between two duplicates. The value is the default std
of a keypoint position. [ours]"""
NUM_CORNERS = 200
"""Number of corners whose displacement is measured."""
MIN_CORNERS = 50
"""Minimum denominator of the ratio of aligned corners, for images with few corners."""
_HIGH_PASS_SIZE = 5
"""Side of the box filter that is subtracted from thumbnails, because brightness and vignetting
change in edited copies."""
_CORNER_QUALITY = 0.01
"""Minimum corner response relative to the strongest corner, see ``cv2.goodFeaturesToTrack``."""
_CORNER_DISTANCE_PX = 10
"""Minimum distance of two corners in pixels."""
_BLOCK_SIZE = 256
"""Number of thumbnails that are compared with all others at once, which bounds the memory."""


def find_duplicates(context: ExtractionContext) -> dict[int, int]:
    """Find images that show the same view as an earlier image of the same size.

    Args:
        context: Context of the extraction with images and cache, which keeps the result.

    Returns:
        Index of the original image by index of the duplicate. The original is the first image of a
        view.
    """
    if context.originals is None:
        context.originals = _search_duplicates(context)
    return context.originals


def _search_duplicates(context: ExtractionContext) -> dict[int, int]:
    """Compare similar images, and return the original of each duplicate."""
    images = context.images
    groups = group_similar(
        [images.thumbnail(index) for index in range(len(images))],
        [image.pinhole.size for image in images],
    )
    if not groups:
        return {}
    key = content_key(hash_module(__name__), [images.pixel_key(i) for i in range(len(images))])
    found = context.cache.load("duplicates", key, np.ndarray)
    if found is None:

        def compare(group: Mapping[int, Sequence[int]]) -> list[tuple[int, int]]:
            return _compare_group(context, group)

        parts = context.each("duplicates", groups, compare)
        found = np.array([pair for part in parts for pair in part], dtype=np.int64).reshape(-1, 2)
        context.cache.store("duplicates", key, found)
    return {int(image): int(original) for image, original in sorted(found.tolist())}


def group_similar(
    thumbnails: Sequence[UInt8], sizes: Sequence[tuple[int, int]]
) -> list[dict[int, list[int]]]:
    """Group images of the same size whose thumbnails correlate.

    Args:
        thumbnails: Gray thumbnails (h, w) of equal size.
        sizes: (width, height) of the images in pixels.

    Returns:
        Similar images of smaller index by image index, in ascending order, for each connected
        component of similar images.
    """
    pairs = np.empty((0, 2), dtype=np.int64)
    for size in sorted(set(sizes)):
        images = np.array([row for row, other in enumerate(sizes) if other == size])
        vectors = np.stack([_normalize_thumbnail(thumbnails[image]) for image in images])
        pairs = np.concatenate([pairs, *(images[rows] for rows in _find_similar(vectors))])
    shape = len(sizes), len(sizes)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
    _, component_of = connected_components(graph, directed=False)
    groups: dict[int, dict[int, list[int]]] = {}
    for image, other in sorted(pairs.tolist()):
        groups.setdefault(int(component_of[image]), {}).setdefault(image, []).append(other)
    return list(groups.values())


def _normalize_thumbnail(thumbnail: UInt8) -> Float32:
    """Return a thumbnail as a vector (h * w,) of length 1, without mean and low frequencies."""
    gray = thumbnail.astype(np.float32)
    detail = gray - cv2.blur(gray, (_HIGH_PASS_SIZE, _HIGH_PASS_SIZE))
    detail = (detail - detail.mean()).ravel()
    unit: Float32 = detail / max(float(np.linalg.norm(detail)), 1e-6)
    return unit


def _find_similar(vectors: Float32) -> Iterator[Int64]:
    """Yield the pairs (n, 2) of vectors with a large dot product, the larger index first."""
    for start in range(0, len(vectors), _BLOCK_SIZE):
        rows, columns = np.nonzero(
            vectors[start : start + _BLOCK_SIZE] @ vectors.T >= MIN_CORRELATION
        )
        pairs = np.stack([start + rows, columns], axis=1)
        yield pairs[pairs[:, 0] > pairs[:, 1]]


def _compare_group(
    context: ExtractionContext, group: Mapping[int, Sequence[int]]
) -> list[tuple[int, int]]:
    """Return pairs of a duplicate and its original in a group of similar images."""
    duplicates: dict[int, int] = {}
    for image, similar in group.items():
        for other in similar:
            if other not in duplicates and _is_duplicate(context, other, image):
                duplicates[image] = other
                break
    return list(duplicates.items())


def _is_duplicate(context: ExtractionContext, original: int, image: int) -> bool:
    """Return whether two images have equal pixels, or show corners at the same pixels."""
    images = context.images
    if images.pixel_key(original) == images.pixel_key(image):
        return True
    ratio = measure_aligned_ratio(images.view(original).image, images.view(image).image)
    return ratio >= MIN_ALIGNED_RATIO


def measure_aligned_ratio(first: UInt8, second: UInt8) -> float:
    """Measure the ratio of the corners of an image that are at the same pixels of another image.

    Args:
        first: RGB image (h, w, 3).
        second: RGB image of the same size.
    """
    corners = find_corners(first)
    if not len(corners):
        return 0.0
    # The camera cancels out, because both images have the same camera and pose.
    height, width = first.shape[:2]
    camera = PinholeCamera(width, height, width, width, width / 2, height / 2)
    a, b = (PairSide(camera, smooth_gray_image(rgb, 1.0), corners, 1.0) for rgb in (first, second))
    aligned = align_pair(a, b, np.eye(3), np.zeros(3))
    is_still = np.linalg.norm(aligned.offset, axis=1) < MAX_SHIFT_PX
    return float(np.count_nonzero(is_still) / max(len(corners), MIN_CORNERS))


def find_corners(rgb: UInt8) -> Float64:
    """Find the strongest corners (n, 2) of an RGB image, in COLMAP pixels."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    found = cv2.goodFeaturesToTrack(gray, NUM_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
    corners: Float64 = np.empty((0, 2)) if found is None else found[:, 0].astype(np.float64) + 0.5
    return corners
