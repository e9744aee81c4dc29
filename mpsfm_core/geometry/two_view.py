"""Two-view geometry of matched keypoints, estimated by COLMAP's LO-RANSAC."""

from __future__ import annotations

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.geometry.projection import rays
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole

_Configuration = pycolmap.TwoViewGeometryConfiguration
MIN_TRIALS = 30
"""Minimum number of RANSAC trials. If nearly all matches are inliers, COLMAP's default of 100 takes
up to twice as long. [tuned: benchmarks/results/walks.md]"""
MAX_TRIALS = 20_000
"""Maximum number of RANSAC trials. [reference]"""
MAX_ERROR_STDS = 4.0
"""Ratio of ``max_error_px`` to the standard deviation of the keypoints, which the likelihood needs.
[COLMAP max_error of 4 pixels, if the standard deviation is one pixel]"""
MIN_EVIDENCE = 3.0
"""Smallest gain in log-likelihood for which the relative pose comes from the essential matrix and
not from the homography of a planar pair. The value is strong evidence on the scale of Kass and
Raftery ("Bayes Factors", 1995)."""


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

    COLMAP classifies a pair as planar, with the relative pose from a homography, if the homography
    has at least 0.8 times as many inliers as the essential matrix. At low parallax, this is also
    true if the scene is not planar. Therefore a planar pair becomes calibrated, with the relative
    pose from the essential matrix, if this pose is clearly more likely.

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
    colmap_a, colmap_b = colmap_from_pinhole(camera_a), colmap_from_pinhole(camera_b)
    rows = np.repeat(np.arange(len(xy_a), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        colmap_a, xy_a, colmap_b, xy_b, rows, options
    )
    if geometry.config != _Configuration.PLANAR or geometry.E is None:
        return geometry
    general = pycolmap.TwoViewGeometry(
        {
            "config": _Configuration.CALIBRATED,
            "E": geometry.E,
            "inlier_matches": geometry.inlier_matches,
        }
    )
    if not pycolmap.estimate_two_view_geometry_pose(colmap_a, xy_a, colmap_b, xy_b, general):
        return geometry
    inliers = geometry.inlier_matches[:, 0]
    observed = rays(camera_a, xy_a[inliers]), rays(camera_b, xy_b[inliers])
    std = max_error_px / MAX_ERROR_STDS / np.sqrt(camera_a.fx * camera_b.fx)
    gain = _log_likelihood(general, *observed, std) - _log_likelihood(geometry, *observed, std)
    return general if gain > MIN_EVIDENCE else geometry


def _log_likelihood(
    geometry: pycolmap.TwoViewGeometry, rays_a: Float64, rays_b: Float64, std: float
) -> float:
    """Return the log-likelihood of all matches for a relative pose.

    The Sampson errors are assumed to be Cauchy-distributed. Constant terms are left out.

    Args:
        geometry: Two-view geometry with a relative pose.
        rays_a: (m, 3) viewing rays of the matched keypoints of the first view, with z = 1.
        rays_b: (m, 3) viewing rays of the second view.
        std: Standard deviation of the keypoints, relative to the focal length.
    """
    essential = pycolmap.essential_matrix_from_pose(geometry.cam2_from_cam1)
    squared = pycolmap.compute_squared_sampson_error(rays_a[:, :2], rays_b[:, :2], essential)
    return -float(np.log1p(np.array(squared) / std**2).sum())
