"""Detection of duplicates, such as copies, exposure brackets or frames of a camera at rest.

Duplicates have most keypoints at the same pixels. Matching a duplicate with all other images wastes
time, because a duplicate adds no parallax.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Features, Float64, Int64, VerifiedPair

MIN_SHARED_RATIO = 0.3
"""Minimum ratio of the keypoints of two duplicates that are at equal pixels, beyond chance. The
measured ratio is 0.5 to 1 for edited copies, and below 0.1 for images of different views. [ours]"""
MIN_KEYPOINTS = 50
"""Minimum denominator of the ratio of keypoints at equal pixels, for images with few keypoints."""


def find_duplicates(
    features: Sequence[Features], sizes: Sequence[tuple[int, int]]
) -> dict[int, int]:
    """Find duplicates, which show the same view as an earlier image of the same size.

    Args:
        features: Features of the images, with keypoints in pixels.
        sizes: (width, height) of the images in pixels.

    Returns:
        Index of the original image by index of the duplicate. The original is the first image of a
        view.
    """
    shared = np.zeros((len(sizes), len(sizes)))
    for size in set(sizes):
        images = np.array([row for row, other in enumerate(sizes) if other == size])
        shared[np.ix_(images, images)] = _measure_shared_ratios(
            [features[image].keypoints for image in images], size
        )
    duplicates: dict[int, int] = {}
    for image in range(len(sizes)):
        for original in range(image):
            if original not in duplicates and shared[original, image] >= MIN_SHARED_RATIO:
                duplicates[image] = original
                break
    return duplicates


def restrict_matches(
    pairs: Sequence[VerifiedPair], duplicates: Mapping[int, int], min_matches: int
) -> tuple[VerifiedPair, ...]:
    """Remove matches of duplicates with their originals that no other image can triangulate.

    An original and its duplicate have no parallax. A match between an original and its duplicate is
    kept if the keypoint of the original also has a match in another image.

    Args:
        pairs: Verified pairs of all images.
        duplicates: Original image by index of the duplicate.
        min_matches: Minimum number of matches that remain; a pair with fewer keeps all its matches.
    """
    matched: dict[int, list[Int64]] = {}
    for pair in pairs:
        if duplicates.get(pair.image_b) != pair.image_a:
            matched.setdefault(pair.image_a, []).append(pair.matches[:, 0])
            matched.setdefault(pair.image_b, []).append(pair.matches[:, 1])
    restricted = []
    for pair in pairs:
        if duplicates.get(pair.image_b) == pair.image_a and pair.image_a in matched:
            is_kept = np.isin(pair.matches[:, 0], np.concatenate(matched[pair.image_a]))
            if is_kept.sum() >= min_matches:
                pair = replace(pair, matches=pair.matches[is_kept], scores=pair.scores[is_kept])
        restricted.append(pair)
    return tuple(restricted)


def _measure_shared_ratios(keypoints: Sequence[Float64], size: tuple[int, int]) -> Float64:
    """Return the ratio (n, n) of keypoints at equal pixels, beyond chance, of n x n images.

    Keypoint coordinates are rounded down to pixels. The expected ratio of randomly distributed
    keypoints is 0.
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
    common = (occupied @ occupied.T).toarray()
    ratio = common / np.maximum(np.minimum(counts[:, None], counts), MIN_KEYPOINTS)
    chance = np.maximum(counts[:, None], counts) / (width * height)
    shared: Float64 = (ratio - chance) / np.maximum(1 - chance, 1e-9)
    return shared
