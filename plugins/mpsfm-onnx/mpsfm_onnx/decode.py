"""Conversion of network outputs to depth, normals and their variances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_onnx.description import (
    ConfidenceOutput,
    DepthOutput,
    KappaOutput,
    Layout,
    NormalsOutput,
)

_GRID = np.arange(64)
"""Number of rows and columns of the pixel grid that estimates the unknown z-shift of points."""
_GAUSS_NEWTON_STEPS = 20
_SMALLEST_RELATIVE_STD = 1e-4
"""Minimum std of depth relative to depth, because a variance must be positive. The variance
calibration of a network sets its own, larger minimum.
"""


def to_planes(output: NDArray[Any], layout: Layout) -> Float32:
    """Convert an output tensor for one image to (h, w, c) float32, adding c = 1 if needed."""
    array = np.asarray(output, dtype=np.float32)
    if array.ndim == 4 or (array.ndim == 3 and array.shape[0] == 1):
        array = array[0]
    if array.ndim == 2:
        return array[..., None]
    return array.transpose(1, 2, 0) if layout == "NCHW" else array


def decode_depth(
    value: Float32,
    rule: DepthOutput,
    camera: PinholeCamera,
    factor: float = 1.0,
    std: Float32 | None = None,
    std_rule: ConfidenceOutput | None = None,
    valid: Bool | None = None,
) -> DepthPrior:
    """Decode the depth of a view and its variance from the output tensors of a network.

    Args:
        value: The depth tensor (h, w, c), in units of the network.
        rule: Description of the depth tensor.
        camera: Camera of the view that ``value`` covers.
        factor: Multiplier of depth and std that corrects for focal length and network unit.
        std: The depth uncertainty tensor (h, w), or None.
        std_rule: Description of the depth uncertainty tensor.
        valid: Mask (h, w) of the pixels that the network predicts to be valid, or None.

    Returns:
        The depth prior, at the resolution of the network output.
    """
    depth = _network_depth(value, rule, camera, valid)
    usable = np.isfinite(depth) & (depth > rule.valid_min)
    if rule.valid_max is not None:
        usable &= depth < rule.valid_max
    if valid is not None:
        usable &= valid
    variance = None
    if std is not None and std_rule is not None:
        variance = (factor * _depth_std(depth, std.astype(np.float64), std_rule)) ** 2
    return DepthPrior.from_arrays(depth * factor, variance, usable, metric=rule.metric)


def _network_depth(
    value: Float32, rule: DepthOutput, camera: PinholeCamera, valid: Bool | None
) -> Float64:
    """Compute z-depth (h, w) in units of the network, NaN or infinite where undefined."""
    height, width = value.shape[:2]
    xy = rays(camera.resized(width, height), pixel_centers(width, height))[..., :2]
    quantity = value[..., rule.channel].astype(np.float64) * rule.scale + rule.shift
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        if rule.output == "log-depth":
            return np.asarray(np.exp(quantity))
        if rule.output == "points":
            points = value.astype(np.float64)
            quantity = points[..., 2] + estimate_z_shift(points, xy, valid)
        positive: Float64 = np.where(quantity > 0, quantity, np.nan)
        if rule.output == "disparity":
            positive = 1.0 / positive
        elif rule.output == "ray-length":
            positive = positive / np.sqrt(1 + (xy**2).sum(axis=-1))
        return positive


def estimate_z_shift(points: Float64, xy: Float64, valid: Bool | None = None) -> float:
    """Estimate the unknown shift t of z for points (h, w, 3) on known rays ``(x, y, 1)``.

    ``xy`` (h, w, 2) are x and y of the rays. The z-shift t minimizes the reprojection error ``sum
    |(x_i, y_i) / (z_i + t) - xy_i|^2`` on a grid of 64 x 64 pixels by Gauss-Newton, as in MoGe. The
    initial t minimizes the linear error ``sum |(x_i, y_i) - xy_i (z_i + t)|^2 / z_i^2``.
    """
    usable = np.isfinite(points).all(axis=-1) & (points[..., 2] > 0)
    if valid is not None:
        usable &= valid
    height, width = usable.shape
    grid = np.ix_(_GRID * height // len(_GRID), _GRID * width // len(_GRID))
    chosen = usable[grid]
    if not chosen.any():
        return 0.0
    (x_y, z), on_ray = np.split(points[grid][chosen], [2], axis=-1), xy[grid][chosen]
    slope = on_ray / z
    shift = _step((x_y - on_ray * z) / z, slope)
    for _ in range(_GAUSS_NEWTON_STEPS):
        shift = max(shift, -0.99 * float(z.min()))  # keeps all points in front of the camera
        depth = z + shift
        step = _step(x_y / depth - on_ray, x_y / depth**2)
        shift += step
        if abs(step) < 1e-9 * float(depth.mean()):
            break
    return max(shift, -0.99 * float(z.min()))


def _step(miss: Float64, slope: Float64) -> float:
    """Compute the Gauss-Newton step of the z-shift from residuals and Jacobian (``slope``)."""
    return float((miss * slope).sum() / max((slope**2).sum(), 1e-12))


def _depth_std(depth: Float64, tensor: Float64, rule: ConfidenceOutput) -> Float64:
    if rule.output == "confidence":
        std = depth * (1 - np.clip(tensor, 0, 1))
    elif rule.output == "std":
        std = tensor
    elif rule.output == "exp-std":
        std = np.log(np.maximum(tensor, 1))
    else:
        std = np.sqrt(np.maximum(tensor, 0))
    return np.maximum(std, _SMALLEST_RELATIVE_STD * depth)


def decode_normals(
    value: Float32,
    rule: NormalsOutput,
    camera: PinholeCamera,
    std: Float64 | None = None,
    valid: Bool | None = None,
) -> NormalPrior:
    """Decode normals, and their variance from an angular std (h, w) in rad.

    The first channels of the tensor ``value`` (h, w, 3 or more) are x, y, z of the normals. Normals
    that do not face the ``camera`` are invalid, and so are pixels outside of the mask ``valid``.
    """
    variance = None if std is None else std**2
    normals = value[..., :3] * np.array(rule.axes, dtype=np.float32)
    return NormalPrior.from_arrays(normals, variance, valid, camera=camera)


def angular_std(value: Float32, rule: KappaOutput) -> Float64:
    """Compute the std (h, w) of normals about each axis in rad from the uncertainty tensor."""
    tensor = value[..., rule.channel].astype(np.float64)
    return compute_expected_angle(tensor) if rule.output == "kappa" else np.maximum(tensor, 0)


def compute_expected_angle(kappa: Float64) -> Float64:
    """Compute the mean angular error in rad of a normal with concentration ``kappa``.

    The density of normals over the sphere is ``(k^2 + 1) exp(-k a) / (2 pi (1 + exp(-k pi)))``,
    where a is the angle to the mean normal (Bae et al., ICCV 2021, DSINE and Metric3D v2). The mean
    angle to the mean normal is ``2k / (k^2 + 1) + pi e / (1 + e)`` with ``e = exp(-k pi)``. For
    large k, the mean angle overestimates the std by 15 %.
    """
    k = np.maximum(kappa, 0)
    tail = np.exp(-k * np.pi)
    angle: Float64 = 2 * k / (k**2 + 1) + np.pi * tail / (1 + tail)
    return angle
