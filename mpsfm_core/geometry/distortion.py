"""Radial distortion of normalized coordinates by COLMAP's SIMPLE_RADIAL model.

A ray ``(u, v, 1)`` is distorted to ``(u, v) (1 + k r^2)`` with ``r^2 = u^2 + v^2``.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.geometry.projection import project, rays

NUM_ITERATIONS = 20
"""Number of Newton iterations that invert the distortion to machine precision. [ours]"""
MIN_SLOPE = 0.1
"""Smallest derivative ``1 + 3 k r^2`` of the distorted radius for which the distortion is inverted.
A negative coefficient ``k`` folds the image over where the derivative is negative. [ours]"""


def distort_rays(rays_xy: Float64, radial: float) -> Float64:
    """Distort normalized coordinates (n, 2) by the radial distortion coefficient ``radial``."""
    squared_radius = (rays_xy**2).sum(axis=1, keepdims=True)
    distorted: Float64 = rays_xy * (1 + radial * squared_radius)
    return distorted


def undistort_rays(distorted: Float64, radial: float) -> Float64:
    """Invert the radial distortion of normalized coordinates by Newton's method on the radius.

    Args:
        distorted: (n, 2) distorted normalized coordinates ``(xy - c) / f``.
        radial: Radial distortion coefficient ``k``.

    Returns:
        (n, 2) undistorted normalized coordinates. If the distortion has no inverse at a point, the
        point gets the largest undistorted radius at which the derivative of the distorted radius is
        at least ``MIN_SLOPE``.
    """
    length = np.linalg.norm(distorted, axis=1)
    max_radius = np.sqrt((1 - MIN_SLOPE) / (-3 * radial)) if radial < 0 else np.inf
    radius = np.minimum(length, max_radius)
    for _ in range(NUM_ITERATIONS):
        slope = 1 + 3 * radial * radius**2
        radius = radius - (radius * (1 + radial * radius**2) - length) / slope
        radius = np.clip(radius, 0, max_radius)
    scale = np.divide(radius, length, out=np.ones_like(length), where=length > 0)
    undistorted: Float64 = distorted * scale[:, None]
    return undistorted


def change_distortion(
    xy: Float64, old: tuple[PinholeCamera, float], new: tuple[PinholeCamera, float]
) -> Float64:
    """Convert undistorted pixels to another camera and radial distortion coefficient.

    Args:
        xy: (n, 2) pixels that were undistorted with the old camera.
        old: Old pinhole camera, and the radial distortion coefficient that was removed from ``xy``.
        new: New pinhole camera of the same image, and the radial distortion coefficient to remove.

    Returns:
        (n, 2) pixels of the new pinhole camera.
    """
    if old[1] == new[1] == 0.0:
        return xy
    camera, radial = old
    distorted = project(camera, _to_points(distort_rays(rays(camera, xy)[:, :2], radial)))
    camera, radial = new
    return project(camera, _to_points(undistort_rays(rays(camera, distorted)[:, :2], radial)))


def _to_points(xy: Float64) -> Float64:
    """Append the third coordinate 1 to normalized coordinates."""
    return np.column_stack([xy, np.ones(len(xy))])
