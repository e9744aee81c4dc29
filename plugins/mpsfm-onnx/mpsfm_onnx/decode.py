"""What a network's numbers mean: depth, its uncertainty, normals and theirs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.data import Float32, Float64
from mpsfm_onnx.description import (
    ConfidenceOutput,
    DepthOutput,
    Layout,
    NormalsOutput,
)

_SMALLEST_RELATIVE_STD = 1e-4
"""A network that is perfectly sure still needs a positive variance; calibration has its floor."""


def planes(output: NDArray[Any], layout: Layout) -> Float32:
    """An output tensor of one image as (h, w, c) float32; a missing channel axis is added."""
    array = np.asarray(output, dtype=np.float32)
    if array.ndim == 4 or (array.ndim == 3 and array.shape[0] == 1):
        array = array[0]
    if array.ndim == 2:
        return array[..., None]
    return array.transpose(1, 2, 0) if layout == "NCHW" else array


def decode_depth(
    value: Float32,
    rule: DepthOutput,
    canonical_ratio: float,
    confidence: Float32 | None = None,
    confidence_rule: ConfidenceOutput | None = None,
) -> DepthPrior:
    """Depth and its variance.

    Args:
        value: (h, w), the depth tensor. rule: what it means.
        canonical_ratio: focal length / canonical focal length (1 without a canonical camera).
        confidence, confidence_rule: the (h, w) uncertainty tensor and what it means.
    """
    quantity = value.astype(np.float64) * rule.scale + rule.shift
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        if rule.output == "log-depth":
            depth = np.exp(quantity)
        else:
            positive = np.where(quantity > 0, quantity, np.nan)
            depth = positive if rule.output == "depth" else 1.0 / positive
        valid = np.isfinite(depth) & (depth > rule.valid_min)
        if rule.valid_max is not None:
            valid &= depth < rule.valid_max
    variance = None
    if confidence is not None and confidence_rule is not None:
        std = _depth_std(depth, confidence.astype(np.float64), confidence_rule)
        variance = (std * canonical_ratio) ** 2
    return DepthPrior.from_arrays(depth * canonical_ratio, variance, valid, metric=rule.metric)


def _depth_std(depth: Float64, tensor: Float64, rule: ConfidenceOutput) -> Float64:
    if rule.output == "confidence":
        std = depth * (1 - np.clip(tensor, 0, 1))
    elif rule.output == "std":
        std = tensor
    else:
        std = np.sqrt(np.maximum(tensor, 0))
    return np.maximum(std, _SMALLEST_RELATIVE_STD * depth)


def decode_normals(
    value: Float32, rule: NormalsOutput, camera: PinholeCamera, kappa: Float32 | None = None
) -> NormalPrior:
    """Normals and their angular variance from (h, w, 3 or more) and the (h, w) concentration.

    Pixels whose normal does not face the ``camera`` of the view are invalid.
    """
    variance = None if kappa is None else expected_angle(kappa.astype(np.float64)) ** 2
    normals = value[..., :3] * np.array(rule.axes, dtype=np.float32)
    return NormalPrior.from_arrays(normals, variance, camera=camera)


def expected_angle(kappa: Float64) -> Float64:
    """Mean angle in rad between a normal and the predicted one, for concentration ``kappa``.

    Of the density ``(k^2 + 1) exp(-k a) / (2 pi (1 + exp(-k pi)))`` over the sphere (Bae et al.,
    ICCV 2021, as DSINE and Metric3D v2 use it): ``2k / (k^2 + 1) + pi e / (1 + e)`` with
    ``e = exp(-k pi)``. Its square serves as the variance along one tangent direction (reference);
    that is 4 / k^2 for large k where the density has 3 / k^2: 15 % too large a std, on the
    cautious side.
    """
    k = np.maximum(kappa, 0)
    tail = np.exp(-k * np.pi)
    angle: Float64 = 2 * k / (k**2 + 1) + np.pi * tail / (1 + tail)
    return angle
