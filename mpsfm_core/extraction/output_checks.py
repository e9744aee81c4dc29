"""Checks of a whole run for errors of the features provider and the matcher."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data import Bool, Float32
from mpsfm_core.data.decisions import DoubtReason, Reason
from mpsfm_core.data.mapping_problem import MappingImage

_MIN_IMAGES = 3
_MIN_KEYPOINTS = 50
_MAX_EXTENT = 0.8
"""Maximum right and lower end of all keypoints, relative to image size, that causes a doubt."""
_MAX_MARGIN = 0.1
"""Maximum left and upper margin of the keypoints, relative to image size, that causes a doubt.
An object in the image center has a larger margin, and therefore causes no doubt."""
_MIN_OUTLIERS = 60
"""Minimum number of outliers in all pairs whose scores are compared. For meaningless scores, the
area under the ROC curve of 60 outliers is 0.5 with a std of 0.04."""
_CHANCE_AUC = 0.5
"""Probability that an inlier has a higher score than an outlier if scores mean nothing."""


def find_partial_coverage(images: Sequence[MappingImage], provider: str) -> Reason | None:
    """Find out whether keypoints cover only the upper left part of every image.

    A wrong provider returns keypoints in pixels of a reduced or cropped image, or only of the first
    tile of an image. Keypoints in wrong pixels give wrong poses of all images.

    Args:
        images: Images with their keypoints.
        provider: Name of the features provider.

    Returns:
        Reason (``DoubtReason``) to doubt the run, or None.
    """
    extents = [
        np.stack([image.keypoints.min(axis=0), image.keypoints.max(axis=0)]) / image.camera.size
        for image in images
        if len(image.keypoints) >= _MIN_KEYPOINTS
    ]
    if len(extents) < _MIN_IMAGES:
        return None
    first, last = np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]
    if first.max() > _MAX_MARGIN or last.max() > _MAX_EXTENT:
        return None
    return DoubtReason.PARTIAL_COVERAGE.because(
        provider=provider,
        num_images=len(extents),
        width_ratio=round(float(last[0]), 3),
        height_ratio=round(float(last[1]), 3),
    )


def find_meaningless_scores(pairs: Sequence[tuple[Float32, Bool]], provider: str) -> Reason | None:
    """Find out whether the scores of matches are not higher for inliers than for outliers.

    Best scores select matches of a keypoint and points of dense matches, so inverted scores select
    outliers. The criterion is the mean over pairs of the area under the ROC curve, weighted by the
    number of outliers of a pair. Equal scores of all matches cause no doubt.

    Args:
        pairs: Scores (m,) float32 of the matches of each verified pair, and mask (m,) bool of the
            inliers.
        provider: Name of the matcher.

    Returns:
        Reason (``DoubtReason``) to doubt the run, or None.
    """
    compared = [
        (scores, inlier)
        for scores, inlier in pairs
        if inlier.any() and not inlier.all() and np.ptp(scores) > 0
    ]
    areas = [_roc_area(scores[inlier], scores[~inlier]) for scores, inlier in compared]
    num_outliers = [int((~inlier).sum()) for _, inlier in compared]
    if sum(num_outliers) < _MIN_OUTLIERS or np.average(areas, weights=num_outliers) > _CHANCE_AUC:
        return None
    return DoubtReason.MEANINGLESS_SCORES.because(provider=provider, num_pairs=len(areas))


def _roc_area(inliers: Float32, outliers: Float32) -> float:
    """Return the probability that an inlier has a higher score than an outlier."""
    ordered = np.sort(outliers)
    lower = np.searchsorted(ordered, inliers, "left") + np.searchsorted(ordered, inliers, "right")
    return float(lower.mean() / 2 / len(ordered))
