"""Two-view geometry of matched keypoints, estimated by COLMAP's LO-RANSAC."""

from __future__ import annotations

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole

MIN_TRIALS = 30
"""Minimum number of RANSAC trials. If nearly all matches are inliers, COLMAP's default of 100 takes
up to twice as long. [tuned: benchmarks/results/walks.md]"""
MAX_TRIALS = 20_000
"""Maximum number of RANSAC trials. [reference]"""


def estimate_two_view_geometry(
    camera_a: PinholeCamera,
    camera_b: PinholeCamera,
    xy_a: Float64,
    xy_b: Float64,
    *,
    max_error_px: float,
    min_inlier_ratio: float,
    min_inliers: int,
    seed: int,
) -> pycolmap.TwoViewGeometry:
    """Estimate the two-view geometry of two calibrated images, with relative pose and inliers.

    The geometry is calibrated if COLMAP prefers the essential matrix to the fundamental matrix and
    to a homography.

    Args:
        camera_a: Camera of the first view.
        camera_b: Camera of the second view.
        xy_a: (m, 2) matched keypoints of the first view, pixels.
        xy_b: (m, 2) matched keypoints of the second view, pixels; row i matches row i of ``xy_a``.
        max_error_px: Largest error of an inlier, pixels.
        min_inlier_ratio: Assumed minimum inlier ratio, which limits the number of RANSAC trials.
        min_inliers: Number of inliers below which the geometry is degenerate.
        seed: Seed of RANSAC; the same input and seed give the same result.
    """
    # Watermark detection is meant for photos from the internet.
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True, detect_watermark=False)
    options.min_num_inliers = min_inliers
    options.ransac.max_error = max_error_px
    options.ransac.min_inlier_ratio = min_inlier_ratio
    options.ransac.min_num_trials = MIN_TRIALS
    options.ransac.max_num_trials = MAX_TRIALS
    options.ransac.random_seed = seed
    return pycolmap.estimate_calibrated_two_view_geometry(
        colmap_from_pinhole(camera_a),
        xy_a,
        colmap_from_pinhole(camera_b),
        xy_b,
        np.repeat(np.arange(len(xy_a), dtype=np.uint32)[:, None], 2, axis=1),
        options,
    )
