"""Distortion of normalized coordinates by COLMAP's OPENCV and OPENCV_FISHEYE models.

The equations are those of :mod:`mpsfm_core.optimize.bundle_kernels`. SIMPLE_RADIAL and RADIAL are
OPENCV with coefficients of 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.data.camera_models import Distortion
from mpsfm_core.geometry.projection import project, rays

NUM_ITERATIONS = 20
"""Number of iterations that invert the distortion to machine precision. [ours]"""
MIN_SLOPE = 0.1
"""Smallest derivative of the distorted radius for which the distortion is inverted. The distortion
folds the image over where the derivative is negative. For a fisheye camera, the derivative is that
by the angle. [ours]"""
MAX_FISHEYE_ANGLE = 1.5
"""Largest angle in radians to the optical axis of a ray of a fisheye camera, which keeps normalized
coordinates finite. [ours]"""


def distort_rays(
    rays_xy: Float64, coefficients: Sequence[float], *, fisheye: bool = False
) -> Float64:
    """Distort normalized coordinates (n, 2).

    Args:
        rays_xy: (n, 2) undistorted normalized coordinates ``(x / z, y / z)``.
        coefficients: k1, k2, p1, p2 of OPENCV, or k1, k2, k3, k4 of OPENCV_FISHEYE.
        fisheye: Use OPENCV_FISHEYE.
    """
    squared_radius = (rays_xy**2).sum(axis=1, keepdims=True)
    if not fisheye:
        radial: Float64 = rays_xy * (1 + squared_radius * _polynomial(squared_radius, coefficients))
        return radial + _tangential(rays_xy, coefficients) if any(coefficients[2:]) else radial
    radius = np.sqrt(squared_radius)
    angle = np.arctan(radius)
    distorted = angle * (1 + angle**2 * _polynomial(angle**2, coefficients, fisheye=True))
    scale = np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0)
    bent: Float64 = rays_xy * scale
    return bent


def undistort_rays(
    distorted: Float64, coefficients: Sequence[float], *, fisheye: bool = False
) -> Float64:
    """Invert the distortion of normalized coordinates.

    Newton's method inverts the radial distortion. Fixed-point iterations subtract the tangential
    distortion.

    Args:
        distorted: (n, 2) distorted normalized coordinates ``(xy - c) / f``.
        coefficients: k1, k2, p1, p2 of OPENCV, or k1, k2, k3, k4 of OPENCV_FISHEYE.
        fisheye: Use OPENCV_FISHEYE.

    Returns:
        (n, 2) undistorted normalized coordinates. If the distortion has no inverse at a point, the
        point gets the largest undistorted radius at which the derivative of the distorted radius is
        at least ``MIN_SLOPE``.
    """
    undistorted = _undistort_radially(distorted, coefficients, fisheye)
    if not fisheye and any(coefficients[2:]):
        for _ in range(NUM_ITERATIONS):
            shift = _tangential(undistorted, coefficients)
            undistorted = _undistort_radially(distorted - shift, coefficients, fisheye)
    return undistorted


def _undistort_radially(
    distorted: Float64, coefficients: Sequence[float], fisheye: bool
) -> Float64:
    """Invert the radial distortion of normalized coordinates (n, 2) by Newton's method."""
    slopes: Float64 = np.array([3.0, 5.0, 7.0, 9.0]) * np.array(coefficients)
    length = np.linalg.norm(distorted, axis=1)
    max_radius = _max_radius(slopes, fisheye)
    radius = np.minimum(length, max_radius)
    for _ in range(NUM_ITERATIONS):
        squared = radius**2
        slope = 1 + squared * _polynomial(squared, slopes, fisheye=fisheye)
        value = radius * (1 + squared * _polynomial(squared, coefficients, fisheye=fisheye))
        radius = np.clip(radius - (value - length) / slope, 0, max_radius)
    radius = np.tan(radius) if fisheye else radius
    scale = np.divide(radius, length, out=np.ones_like(length), where=length > 0)
    undistorted: Float64 = distorted * scale[:, None]
    return undistorted


def _max_radius(slopes: Float64, fisheye: bool) -> float:
    """Return the smallest radius, or fisheye angle, with the derivative ``MIN_SLOPE``."""
    used = slopes if fisheye else slopes[:2]
    roots = np.roots([*used[::-1], 1 - MIN_SLOPE])
    squared = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(min([*np.sqrt(squared), MAX_FISHEYE_ANGLE if fisheye else np.inf]))


def _polynomial(
    squared: Float64, coefficients: Sequence[float] | Float64, *, fisheye: bool = False
) -> Float64:
    """Evaluate ``c1 + c2 s + c3 s^2 + c4 s^3``, without c3 and c4 if not ``fisheye``."""
    c1, c2, c3, c4 = coefficients
    if fisheye:
        return np.asarray(c1 + squared * (c2 + squared * (c3 + squared * c4)))
    return np.asarray(c1 + squared * c2)


def _tangential(rays_xy: Float64, coefficients: Sequence[float]) -> Float64:
    """Return the tangential distortion (n, 2) of OPENCV."""
    (u, v), (p1, p2) = rays_xy.T, coefficients[2:]
    r2 = u**2 + v**2
    shift = [2 * p1 * u * v + p2 * (r2 + 2 * u**2), 2 * p2 * u * v + p1 * (r2 + 2 * v**2)]
    return np.stack(shift, axis=1)


def change_distortion(
    xy: Float64,
    old: tuple[PinholeCamera, Distortion],
    new: tuple[PinholeCamera, Distortion],
) -> Float64:
    """Convert undistorted pixels to another OPENCV camera.

    Args:
        xy: (n, 2) pixels that were undistorted with the old camera.
        old: Old pinhole camera, and the distortion coefficients that were removed from ``xy``.
        new: New pinhole camera of the same image, and the distortion coefficients to
            remove.

    Returns:
        (n, 2) pixels of the new pinhole camera.
    """
    if not any(old[1]) and not any(new[1]):
        return xy
    camera, coefficients = old
    distorted = project(camera, _to_points(distort_rays(rays(camera, xy)[:, :2], coefficients)))
    camera, coefficients = new
    return project(camera, _to_points(undistort_rays(rays(camera, distorted)[:, :2], coefficients)))


def _to_points(xy: Float64) -> Float64:
    """Append the third coordinate 1 to normalized coordinates."""
    return np.column_stack([xy, np.ones(len(xy))])
