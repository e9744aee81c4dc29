"""Conversion of dense matches to matches of existing or newly sampled keypoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, DenseMatches, Float32, Float64, Int64, SparseMatches

_MIN_SCORE = 0.1
"""Minimum score of a sampled dense match. [reference RoMa]"""
_MIN_KEYPOINT_DISTANCE_PX = 6.0
"""Minimum distance between a sampled dense match and keypoints, pixels. [reference
sparse_nms_radius]"""
_NMS_RADIUS_PX = 8.0
"""Radius of non-maximum suppression among sampled dense matches, pixels. [reference]"""


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Point correspondences of an image pair that are not tied to detected keypoints."""

    xy_a: Float64
    """(m, 2) matched points in the first view in pixels."""
    xy_b: Float64
    """(m, 2) matched points in the second view in pixels."""
    scores: Float32
    """(m,) scores of the matches."""


NO_POINTS = PointMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.float32))


def snap_to_keypoints(
    dense: DenseMatches, keypoints_a: Float64, keypoints_b: Float64, radius_px: float
) -> SparseMatches:
    """Assign dense matches to the nearest keypoints of both views.

    If several dense matches are nearest to a keypoint, the match with the best score is used.

    Args:
        dense: Dense matches of the image pair.
        keypoints_a: (n, 2) keypoints of the first view, pixels.
        keypoints_b: (k, 2) keypoints of the second view, pixels.
        radius_px: Maximum distance between dense match and keypoint, pixels.
    """
    distance_a, row_a = _nearest(keypoints_a, dense.points_a)
    distance_b, row_b = _nearest(keypoints_b, dense.points_b)
    near = (distance_a <= radius_px) & (distance_b <= radius_px)
    rows = np.stack([row_a[near], row_b[near]], axis=1)
    return SparseMatches.from_best_scores(rows, dense.scores[near])


def sample_dense_matches(
    dense: DenseMatches, keypoints_a: Float64, keypoints_b: Float64
) -> PointMatches:
    """Select confident dense matches that are distant from keypoints and from each other.

    The selection follows the appendix "two-view correspondences" of the MP-SfM paper.

    Args:
        dense: Dense matches of the image pair.
        keypoints_a: (n, 2) keypoints of the first view, pixels.
        keypoints_b: (k, 2) keypoints of the second view, pixels.
    """
    is_usable = dense.scores >= _MIN_SCORE
    for keypoints, points in ((keypoints_a, dense.points_a), (keypoints_b, dense.points_b)):
        is_usable &= _nearest(keypoints, points)[0] >= _MIN_KEYPOINT_DISTANCE_PX
    rows = np.flatnonzero(is_usable)
    rows = rows[np.argsort(-dense.scores[rows], kind="stable")]
    rows = rows[_suppress_neighbors(dense.points_a[rows])]
    rows = rows[_suppress_neighbors(dense.points_b[rows])]
    return PointMatches(dense.points_a[rows], dense.points_b[rows], dense.scores[rows])


def _suppress_neighbors(points: Float64) -> Bool:
    """Apply greedy non-maximum suppression to points (n, 2) that are sorted best first."""
    survives = np.ones(len(points), dtype=np.bool_)
    if not len(points):
        return survives
    radius = np.nextafter(_NMS_RADIUS_PX, 0)
    pairs = np.sort(cKDTree(points).query_pairs(radius, output_type="ndarray"), axis=1)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(points) + 1))
    for row in range(len(points)):
        if survives[row]:
            survives[pairs[bounds[row] : bounds[row + 1], 1]] = False
    return survives


def _nearest(keypoints: Float64, points: Float64) -> tuple[Float64, Int64]:
    """Return distance and index of each point's nearest keypoint; infinite without keypoints."""
    if not len(keypoints):
        return np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    distance, row = cKDTree(keypoints).query(points)
    return distance, row.astype(np.int64)
