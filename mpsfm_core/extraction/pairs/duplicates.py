"""Detection of duplicates, such as copies, exposure brackets or frames of a camera at rest.

Duplicates have most keypoints at the same pixels. Matching a duplicate with all other images wastes
time, because a duplicate adds no parallax.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Bool, Features, Float64

MIN_SHARED_RATIO = 0.3
"""Minimum ratio of the keypoints of two duplicates that are at equal pixels, beyond chance. The
measured ratio is 0.5 to 1 for edited copies, and below 0.1 for images of different views. [ours]"""
MIN_KEYPOINTS = 50
"""Minimum denominator of the ratio of keypoints at equal pixels, for images with few keypoints."""
BLOCK_SIZE = 256
"""Number of images that are compared with all other images at once, which bounds the memory."""


def find_duplicates(
    features: Sequence[Features], sizes: Sequence[tuple[int, int]]
) -> dict[int, int]:
    """Find images that show the same view as an earlier image of the same size.

    Args:
        features: Features of the images, with keypoints in pixels.
        sizes: (width, height) of the images in pixels.

    Returns:
        Index of the original image by index of the duplicate. The original is the first image of a
        view.
    """
    duplicates: dict[int, int] = {}
    for size in set(sizes):
        images = [row for row, other in enumerate(sizes) if other == size]
        originals: Bool = np.ones(len(images), dtype=np.bool_)
        keypoints = [features[image].keypoints for image in images]
        for number, shared in enumerate(_measure_shared_ratios(keypoints, size)):
            same_view = np.flatnonzero(originals[:number] & (shared >= MIN_SHARED_RATIO))
            if len(same_view):
                duplicates[images[number]] = images[same_view[0]]
                originals[number] = False
    return dict(sorted(duplicates.items()))


def _measure_shared_ratios(
    keypoints: Sequence[Float64], size: tuple[int, int]
) -> Iterator[Float64]:
    """Yield the ratios (k,) of keypoints of image k at equal pixels with the images 0 to k - 1.

    Keypoint coordinates are rounded down to pixels. The ratio that randomly distributed keypoints
    have by chance is subtracted.
    """
    width, height = size
    rows, columns = [], []
    for number, xy in enumerate(keypoints):
        pixels = np.clip(np.floor(xy).astype(np.int64), 0, [width - 1, height - 1])
        cells = np.unique(pixels[:, 1] * width + pixels[:, 0])
        rows.append(np.full(len(cells), number))
        columns.append(cells)
    row, column = np.concatenate(rows), np.concatenate(columns)
    occupied = csr_array((np.ones(len(row)), (row, column)), shape=(len(keypoints), width * height))
    counts = np.bincount(row, minlength=len(keypoints)).astype(np.float64)
    for start in range(0, len(keypoints), BLOCK_SIZE):
        block = (occupied[start : start + BLOCK_SIZE] @ occupied.T).toarray()
        for number, common in enumerate(block, start):
            count, earlier = counts[number], counts[:number]
            ratio = common[:number] / np.maximum(np.minimum(count, earlier), MIN_KEYPOINTS)
            chance = np.maximum(count, earlier) / (width * height)
            yield (ratio - chance) / np.maximum(1 - chance, 1e-9)
