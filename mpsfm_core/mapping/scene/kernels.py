"""Compiled kernels for projection, the observations of tracks, and triangulation angles."""

from __future__ import annotations

import math

import numpy as np

from mpsfm_core.data import Float64, Int64
from mpsfm_core.support import jit


@jit.kernel()
def sort_keypoints_by_point(point_of: Int64, num_points: int) -> Int64:
    """Return the keypoints that observe a point, sorted by point, then by keypoint.

    Args:
        point_of: (k,) int64 index of the point that each keypoint observes, or negative without a
            point.
        num_points: Number of points.
    """
    first = np.zeros(num_points + 1, np.int64)
    for point in point_of:
        if point >= 0:
            first[point + 1] += 1
    first = np.cumsum(first)
    keypoints = np.empty(first[num_points], np.int64)
    for keypoint in range(len(point_of)):
        point = point_of[keypoint]
        if point >= 0:
            keypoints[first[point]] = keypoint
            first[point] += 1
    return keypoints


@jit.kernel()
def project_to_keypoints(
    points: Float64,
    keypoints: Int64,
    xy: Float64,
    image_of: Int64,
    rotations: Float64,
    translations: Float64,
    intrinsics: Float64,
) -> tuple[Float64, Float64]:
    """Project world points into the images of keypoints.

    Args:
        points: (m, 3) float64 points in the world frame.
        keypoints: (m,) int64 keypoint that each point is compared with.
        xy: (k, 2) float64 positions of all keypoints in pixels.
        image_of: (k,) int64 image of each keypoint.
        rotations: (n, 3, 3) float64 rotations ``cam_from_world``.
        translations: (n, 3) float64 ``cam_from_world``.
        intrinsics: (n, 4) float64 intrinsics fx, fy, cx, cy in pixels.

    Returns:
        Reprojection errors (m,) in pixels, inf behind the camera, and depth (m,) of the points.
    """
    errors_px, depth = np.full(len(points), np.inf), np.empty(len(points))
    for m in range(len(points)):
        x, y, z = points[m]
        image = image_of[keypoints[m]]
        r, t = rotations[image], translations[image]
        # products are summed in the order of numpy.einsum, which gives the same bits
        depth[m] = (r[2, 0] * x + r[2, 2] * z) + r[2, 1] * y + t[2]
        if depth[m] > 1e-9:
            fx, fy, cx, cy = intrinsics[image]
            column, row = xy[keypoints[m]]
            u = (r[0, 0] * x + r[0, 2] * z) + r[0, 1] * y + t[0]
            v = (r[1, 0] * x + r[1, 2] * z) + r[1, 1] * y + t[1]
            errors_px[m] = math.hypot(fx * u / depth[m] + cx - column, fy * v / depth[m] + cy - row)
    return errors_px, depth


@jit.kernel()
def compute_max_triangulation_angles(
    points: Float64, observation_points: Int64, centers: Float64
) -> Float64:
    """Compute the largest triangulation angle between two rays of each point's track.

    Args:
        points: (p, 3) float64 points in the world frame.
        observation_points: (o,) int64 row in ``xyz`` of the point of each observation, sorted.
        centers: (o, 3) float64 camera center of each observation, in the world frame.

    Returns:
        (p,) float64 angles in [0, 90] degrees, 0 for points with fewer than two observations.
    """
    angles = np.zeros(len(points))
    count = len(observation_points)
    rays = np.zeros((count, 3))
    for n in range(count):
        x, y, z = points[observation_points[n]] - centers[n]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance > 0:
            rays[n, 0], rays[n, 1], rays[n, 2] = x / distance, y / distance, z / distance
    start = 0
    while start < count:
        point = observation_points[start]
        end = start + 1
        while end < count and observation_points[end] == point:
            end += 1
        best, best_a, best_b = 0.0, start, start
        for a in range(start, end):
            ax, ay, az = rays[a]
            for b in range(a + 1, end):
                bx, by, bz = rays[b]
                cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                squared_sine = cx * cx + cy * cy + cz * cz
                if squared_sine > best:
                    best, best_a, best_b = squared_sine, a, b
        cosine = abs((rays[best_a] * rays[best_b]).sum())
        angles[point] = math.degrees(math.atan2(math.sqrt(best), cosine))
        start = end
    return angles
