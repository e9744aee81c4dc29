"""Accuracy and completeness of a point cloud compared with a scan, as in ETH3D."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.statistics import unique_rows

TOLERANCES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Default distance thresholds in meters [ETH3D]."""
_MEDIAN_SAMPLES = 1000
"""Number of points sampled to estimate a median distance beyond all thresholds."""


def cloud_accuracy(
    points: Float64, scan: Float64, tolerances: Sequence[float] = TOLERANCES
) -> dict[str, Any]:
    """Compare a point cloud with a scan in the same frame.

    The cloud and the scan are subsampled to one point per cube with half the smallest tolerance as
    side. Subsampling gives all regions of a surface equal weight. Points outside the scanned region
    count as errors; crop the cloud first if the scan is partial.

    Args:
        points: (n, 3) points.
        scan: (m, 3) points of the scan, which is the ground truth.
        tolerances: Distance thresholds.

    Returns:
        Accuracy of the point cloud as plain data for JSON. ``accuracy`` maps a tolerance to the
        ratio of cloud points near the scan, ``completeness`` to the ratio of scan points near the
        cloud, ``f1`` to the harmonic mean of accuracy and completeness.

    Raises:
        InputError: The point cloud or the scan is empty.
    """
    if not len(points) or not len(scan):
        raise InputError("cannot compare point clouds: one of them is empty")
    points, scan = (thin_points(cloud, min(tolerances) / 2) for cloud in (points, scan))
    to_scan, median_to_scan = _distances(points, scan, max(tolerances))
    to_points, median_to_points = _distances(scan, points, max(tolerances))
    accuracy = {str(t): float((to_scan <= t).mean()) for t in tolerances}
    completeness = {str(t): float((to_points <= t).mean()) for t in tolerances}
    return {
        "points": len(points),
        "scan_points": len(scan),
        "accuracy": accuracy,
        "completeness": completeness,
        "f1": {t: _harmonic(accuracy[t], completeness[t]) for t in accuracy},
        "median_distance_to_scan": median_to_scan,
        "median_distance_to_points": median_to_points,
    }


def _distances(points: Float64, others: Float64, limit: float) -> tuple[Float64, float]:
    """Compute nearest-neighbor distances (n,), infinite beyond a limit, and the median.

    A median beyond the limit is estimated from a subsample, because unbounded nearest-neighbor
    queries are slow for distant points.
    """
    tree = cKDTree(others)
    distances: Float64 = tree.query(points, distance_upper_bound=np.nextafter(limit, np.inf))[0]
    sample = distances
    if np.isinf(np.median(distances)):
        count = min(len(points), _MEDIAN_SAMPLES)
        sampled = np.random.default_rng(0).choice(len(points), count, replace=False)
        sample = tree.query(points[sampled])[0]
    return distances, float(np.median(sample))


def thin_points(points: Float64, size: float) -> Float64:
    """Subsample a cloud to the first point in each cube of a grid."""
    cells: Int64 = np.floor(points / size).astype(np.int64)
    return points[np.sort(unique_rows(cells)[0])]


def _harmonic(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b > 0 else 0.0
