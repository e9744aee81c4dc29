"""How far a point cloud is from a scan: accuracy and completeness, as ETH3D defines them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.errors import InputError

TOLERANCES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""In the scan's unit (ETH3D, metres)."""

_SAMPLE = 1000
"""Points whose distances tell a median that is beyond all tolerances."""


def cloud_accuracy(
    points: Float64, scan: Float64, tolerances: Sequence[float] = TOLERANCES
) -> dict[str, Any]:
    """Compare points (n, 3) with a scan (m, 3) in the same frame; plain data, ready for JSON.

    ``accuracy``: tolerance -> share of the points that have the scan within it; ``completeness``:
    of the scan that has a point within it; ``f1``: their harmonic mean. Both clouds are thin_points to
    one point a cube of half the smallest tolerance, so that no place counts twice. Points where
    the scanner saw nothing count as wrong: crop the cloud first if the scan is partial.

    Raises :class:`InputError` when a cloud is empty.
    """
    if not len(points) or not len(scan):
        raise InputError("a point cloud is empty, there is nothing to compare")
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
    """To the nearest of others (n,), infinite beyond the limit, and the median.

    If the median is beyond the limit it is that of a sample: in the middle of a room all of it is
    about equally far, so that finding the very nearest takes a walk through all points.
    """
    tree = cKDTree(others)
    found: Float64 = tree.query(points, distance_upper_bound=np.nextafter(limit, np.inf))[0]
    sample = found
    if np.isinf(np.median(found)):
        count = min(len(points), _SAMPLE)
        chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
        sample = tree.query(points[chosen])[0]
    return found, float(np.median(sample))


def thin_points(points: Float64, size: float) -> Float64:
    """The first point of each cube of a grid of this size."""
    cells: Int64 = np.floor(points / size).astype(np.int64)
    order = np.lexsort(cells.T)
    ordered = cells[order]
    first = np.ones(len(points), np.bool_)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return points[np.sort(order[first])]


def _harmonic(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b > 0 else 0.0
