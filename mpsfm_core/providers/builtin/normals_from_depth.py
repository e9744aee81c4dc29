"""Normals provider that fits planes to the depth prior."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior, PinholeCamera, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.options import NormalsFromDepthOptions

_MIN_SUPPORT = 0.5
"""Smallest ratio of pixels with valid depth in the pixel window of a plane fit."""
_MIN_SPREAD = 1e-3
"""Smallest ``det / trace^2`` of the covariance of the pixel positions in a plane fit. The value is
1/4 for a square of pixels and 0 if all pixels are on a line."""
_NOISE_MARGIN = 6.0
"""Smallest deviation of the inverse depth from the neighbors' mean at a depth edge, in multiples of
the noise std of the depth map."""
_VARIANCE_RANGE = (1e-12, np.pi**2)
_MEDIAN_BEND = 1.052
"""Median of ``max(|e1|, |e2|)`` for independent standard normal variables ``e1`` and ``e2``."""
_BEND_NOISE = np.sqrt(1.5)
"""Std of ``w1 - (w0 + w2) / 2`` for inverse depths ``w`` with independent errors of std 1."""


class NormalsFromDepth:
    """Normals provider that fits a least-squares plane in a window around each depth pixel.

    A plane ``dot(g, X) = 1`` has the inverse depth ``1 / z = dot(g, r)`` along the ray ``r = (x, y,
    1)``. The inverse depth ``1 / z`` is linear in the plane vector ``g``, so linear least squares
    gives ``g``, and the normal is ``-g / |g|``. The provider halves the window of a fit until the
    window contains no depth edge.

    Errors of predicted depth maps are smooth over many pixels, because a network bends a wall
    instead of roughening the surface. Depth differences of neighboring pixels are therefore more
    accurate than they would be with independent errors of the declared std. A depth error of
    relative std ``s`` that varies over an angle of ``a`` radians tilts a surface by about ``s /
    a``. The option ``slope_std`` is the ratio of normal std in radians to relative depth std. The
    normal variance is the sum of a term for smooth depth errors, which tilt a surface, and a term
    for independent pixel errors. The residuals of the plane fit determine the term for independent
    pixel errors.
    """

    def __init__(self, options: NormalsFromDepthOptions, context: ProviderContext) -> None:
        self._options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Return plane normals with variance; normals at depth edges and holes are invalid."""
        if depth is None:
            raise ProviderError("the normals provider from-depth requires depth with variance")
        return fit_normals(view.camera, depth, self._options)


def fit_normals(
    camera: PinholeCamera, depth: DepthPrior, options: NormalsFromDepthOptions
) -> NormalPrior:
    """Fit a plane around each pixel of a depth map and return the plane normals.

    Args:
        camera: Pinhole camera of the undistorted image that the depth map covers.
        depth: Depth prior with variance.
        options: Options of the plane fit.

    Returns:
        Unit normals with variance, on the grid of the depth map.

    Raises:
        ProviderError: The depth prior has no variance.
    """
    if depth.variance is None:
        raise ProviderError("the normals provider from-depth requires depth with variance")
    rows, columns = depth.shape
    xy = rays(camera.resized(columns, rows), pixel_centers(columns, rows))[..., :2]
    inverse = 1.0 / np.where(depth.valid, depth.depth, 1.0).astype(np.float64)
    bends = _relative_bends(inverse, depth.valid)
    roughness = float(np.median(bends[depth.valid])) / _MEDIAN_BEND if depth.valid.any() else 0
    edges = bends > max(options.edge, _NOISE_MARGIN * roughness)
    noise = (roughness / _BEND_NOISE * inverse) ** 2
    radius = max(1, round(options.radius * max(rows, columns)))
    fit = _fit_without_edges(xy, inverse, noise, depth.valid & ~edges, edges, radius)
    squared_length = np.maximum((fit.plane**2).sum(axis=-1), 1e-300)
    relative = depth.variance / np.maximum(depth.depth.astype(np.float64), 1e-12) ** 2
    # Seen at a grazing angle, a surface is tilted less by the same relative depth error.
    tilt = options.slope_std**2 * relative * inverse**2
    return NormalPrior.from_arrays(
        -fit.plane / np.sqrt(squared_length)[..., None],
        np.clip((tilt + fit.variance) / squared_length, *_VARIANCE_RANGE),
        fit.solved,
        camera=camera,
    )


class _Fit(NamedTuple):
    """Fitted plane vectors g (h, w, 3), their variance (h, w) perpendicular to g, and validity."""

    plane: Float64
    variance: Float64
    solved: Bool


def _relative_bends(inverse: Float64, valid: Bool) -> Float64:
    """Return the relative deviation of inverse depth from the mean of two neighboring pixels.

    The neighboring pixels are in the same row or in the same column, whichever gives the larger
    deviation. The deviation is 0 on any plane, and is set to 0 if a neighboring pixel is invalid.
    """
    largest = np.zeros(valid.shape)
    for axis in (0, 1):
        w, ok = np.moveaxis(inverse, axis, 0), np.moveaxis(valid, axis, 0)
        bend = np.abs(w[1:-1] - (w[:-2] + w[2:]) / 2) / w[1:-1]
        inner = np.moveaxis(largest, axis, 0)[1:-1]
        np.maximum(inner, np.where(ok[:-2] & ok[1:-1] & ok[2:], bend, 0.0), out=inner)
    return largest


def _fit_without_edges(
    xy: Float64, inverse: Float64, noise: Float64, usable: Bool, edges: Bool, radius: int
) -> _Fit:
    """Fit a plane around each pixel, halving the window radius until the window has no edge."""
    best = _fit_planes(xy, inverse, noise, usable, edges, radius)
    while radius > 1:
        radius //= 2
        smaller = _fit_planes(xy, inverse, noise, usable, edges, radius)
        best = _Fit(
            np.where(best.solved[..., None], best.plane, smaller.plane),
            np.where(best.solved, best.variance, smaller.variance),
            best.solved | smaller.solved,
        )
    return best


def _fit_planes(
    xy: Float64, inverse: Float64, noise: Float64, usable: Bool, edges: Bool, radius: int
) -> _Fit:
    """Fit a plane ``inverse = dot(g, (x, y, 1))`` to the usable pixels around each pixel.

    The array ``noise`` (h, w) is a lower bound for the variance of the inverse depth of a pixel.
    """
    x, y = xy[..., 0], xy[..., 1]
    weight = usable.astype(np.float64)
    count = _window_sum(weight, radius)
    safe = np.maximum(count, 1.0)

    def mean(values: Float64) -> Float64:
        return _window_sum(values * weight, radius) / safe

    mx, my, mw = mean(x), mean(y), mean(inverse)
    xx, xy_, yy = mean(x * x) - mx**2, mean(x * y) - mx * my, mean(y * y) - my**2
    xw, yw = mean(x * inverse) - mx * mw, mean(y * inverse) - my * mw
    determinant = xx * yy - xy_**2
    window = (2 * radius + 1) ** 2
    solved = (
        usable
        & (count >= max(_MIN_SUPPORT * window, 4))
        & (_window_sum(np.ones_like(weight), radius) > window - 0.5)
        & (_window_sum(edges.astype(np.float64), radius) < 0.5)
        & (determinant > _MIN_SPREAD * (xx + yy) ** 2)
    )
    determinant = np.where(solved, determinant, 1.0)
    p = (yy * xw - xy_ * yw) / determinant
    q = (xx * yw - xy_ * xw) / determinant
    residual = (mean(inverse**2) - mw**2 - p * xw - q * yw) * count / np.maximum(count - 3, 1)
    variance = np.maximum(residual, noise) / safe * (xx + yy) / determinant / 2
    return _Fit(np.stack([p, q, mw - p * mx - q * my], axis=-1), variance, solved)


def _window_sum(values: Float64, radius: int) -> Float64:
    side = 2 * radius + 1
    return np.asarray(
        cv2.boxFilter(
            values, cv2.CV_64F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
    )
