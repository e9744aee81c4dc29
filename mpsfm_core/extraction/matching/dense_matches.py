"""Dense matches as keypoints: snapped to features, or sampled apart from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, DenseMatches, Float32, Float64, Int64, SparseMatches
from mpsfm_core.extraction.options import ExtractionOptions


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Matches of a pair that bring their own keypoints: (m, 2) float64 each, scores (m,)."""

    xy_a: Float64
    xy_b: Float64
    scores: Float32


NO_POINTS = PointMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.float32))


def snap_to_keypoints(
    dense: DenseMatches, keypoints_a: Float64, keypoints_b: Float64, radius_px: float
) -> SparseMatches:
    """Dense matches that lie on keypoints in both images, as matches of those.

    Of several for one keypoint the most certain stays.
    """
    distance_a, row_a = _nearest(keypoints_a, dense.points_a)
    distance_b, row_b = _nearest(keypoints_b, dense.points_b)
    near = (distance_a <= radius_px) & (distance_b <= radius_px)
    rows = np.stack([row_a[near], row_b[near]], axis=1)
    return SparseMatches.from_best_scores(rows, dense.scores[near])


def sample_dense_matches(
    dense: DenseMatches, keypoints_a: Float64, keypoints_b: Float64, options: ExtractionOptions
) -> PointMatches:
    """Dense matches that are certain, apart from the keypoints of both images, and apart from
    each other (paper appendix "two-view correspondences", reference)."""
    away = dense.scores >= options.dense_min_score
    for keypoints, points in ((keypoints_a, dense.points_a), (keypoints_b, dense.points_b)):
        away &= _nearest(keypoints, points)[0] >= options.dense_sparse_px
    rows = np.flatnonzero(away)
    rows = rows[np.argsort(-dense.scores[rows], kind="stable")]
    rows = rows[_suppress(dense.points_a[rows], options.dense_nms_px)]
    rows = rows[_suppress(dense.points_b[rows], options.dense_nms_px)]
    return PointMatches(dense.points_a[rows], dense.points_b[rows], dense.scores[rows])


def _suppress(points: Float64, radius_px: float) -> Bool:
    """Which points stay when each removes the later ones nearer than the radius, in order."""
    stays = np.ones(len(points), dtype=np.bool_)
    if radius_px <= 0 or not len(points):
        return stays
    pairs = cKDTree(points).query_pairs(np.nextafter(radius_px, 0), output_type="ndarray")
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(points) + 1))
    for row in range(len(points)):
        if stays[row]:
            stays[pairs[bounds[row] : bounds[row + 1], 1]] = False
    return stays


def _nearest(keypoints: Float64, points: Float64) -> tuple[Float64, Int64]:
    """Distance to the nearest keypoint (infinite if there is none), and its row."""
    if not len(keypoints):
        return np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    distance, row = cKDTree(keypoints).query(points)
    return distance, row.astype(np.int64)
