"""Compiled loops over tracks."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from mpsfm_core.data import Float64, Int64


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def max_triangulation_angles(
    points: Float64, observation_points: Int64, centers: Float64
) -> Float64:
    """Largest angle in degrees between any two rays of each point's track.

    Args:
        points: (p, 3). observation_points: (o,) row of each observation, sorted. centers: (o, 3)
            camera centre of each observation.

    Returns:
        (p,) float64 in [0, 90]; 0 for points with fewer than two observations.
    """
    angles = np.zeros(len(points))
    count = len(observation_points)
    start = 0
    while start < count:
        point = observation_points[start]
        end = start + 1
        while end < count and observation_points[end] == point:
            end += 1
        best = 0.0
        for a in range(start, end):
            ax = points[point, 0] - centers[a, 0]
            ay = points[point, 1] - centers[a, 1]
            az = points[point, 2] - centers[a, 2]
            for b in range(a + 1, end):
                bx = points[point, 0] - centers[b, 0]
                by = points[point, 1] - centers[b, 1]
                bz = points[point, 2] - centers[b, 2]
                cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                sine = math.sqrt(cx * cx + cy * cy + cz * cz)
                angle = math.atan2(sine, abs(ax * bx + ay * by + az * bz))
                best = max(best, angle)
        angles[point] = math.degrees(best)
        start = end
    return angles
