"""Accuracy and completeness of a point cloud compared with a scan, as in ETH3D."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.errors import InputError

TOLERANCES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Distance thresholds in the unit of the scan [ETH3D, meters]."""
_MEDIAN_SAMPLES = 1000
"""Samples that estimate a median beyond all tolerances."""


def cloud_accuracy(
    points: Float64, scan: Float64, tolerances: Sequence[float] = TOLERANCES
) -> dict[str, Any]:
    """Compare a point cloud with a scan in the same frame.

    Both clouds are reduced to one point per cube of half the smallest tolerance, so that dense
    regions do not dominate. Points outside the scanned region count as wrong; crop the cloud first
    if the scan is partial.

    Args:
        points: (n, 3) points.
        scan: (m, 3) points of the scan.
        tolerances: Distance thresholds.

    Returns:
        Plain data for JSON. ``accuracy`` maps a tolerance to the ratio of points near the scan,
        ``completeness`` to the ratio of the scan near points, ``f1`` to their harmonic mean.

    Raises:
        InputError: A cloud is empty.
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
    """Compute nearest-neighbor distances (n,), infinite beyond the limit, and their median.

    A median beyond the limit is estimated from a sample, because unbounded queries are slow for
    points far from all others.
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
    """Keep the first point of each cube of a grid."""
    cells: Int64 = np.floor(points / size).astype(np.int64)
    order = np.lexsort(cells.T)
    ordered = cells[order]
    first = np.ones(len(points), np.bool_)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return points[np.sort(order[first])]


def _harmonic(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b > 0 else 0.0
