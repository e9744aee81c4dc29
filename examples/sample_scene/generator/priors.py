"""Depth and normal priors with simulated errors of a monocular network, and their variances.

Errors are drawn from a seeded generator. Declared variances depend on the standard deviations of
the errors and on the depth spread at blurred edges, never on the drawn errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .cameras import Truth

Float64 = NDArray[np.float64]

FIELD_SCALES = ((0.7, 0.2), (0.55, 0.07), (0.45, 0.025))
"""Weight and correlation length (in map widths) of each noise field; squared weights sum to 1."""


@dataclass(frozen=True)
class PriorErrors:
    """Standard deviations of the simulated prior errors, and edge blur in pixels of the map."""

    std_scale: float = 0.05
    std_depth: float = 0.05
    std_normal_deg: float = 3.0
    amplitude_spread: float = 0.35
    declared_spread: float = 0.15
    blur_px: float = 1.3


@dataclass(frozen=True)
class Prior:
    """Degraded map, its variance (m^2, or rad^2 per tangent axis) and its validity."""

    values: Float64
    variance: Float64
    valid: NDArray[np.bool_]


def degrade_depth(truth: Truth, errors: PriorErrors, rng: np.random.Generator) -> Prior:
    """Degrade exact depth by edge blur, one scale error, and smooth multiplicative noise."""
    valid = truth.depth > 0
    shape = truth.depth.shape
    mean = _blur(truth.depth, valid, errors.blur_px)
    spread = np.maximum(_blur(truth.depth**2, valid, errors.blur_px) - mean**2, 0)
    std_relative = errors.std_depth * np.exp(errors.amplitude_spread * _field(rng, shape))
    scale = np.exp(rng.normal(0, errors.std_scale))
    depth = scale * mean * np.exp(std_relative * _field(rng, shape))
    variance = depth**2 * (errors.std_scale**2 + std_relative**2) + scale**2 * spread
    return Prior(depth, variance * _misjudged(errors, rng, shape), valid)


def degrade_normals(
    truth: Truth, rays: Float64, errors: PriorErrors, rng: np.random.Generator
) -> Prior:
    """Degrade exact normals by edge blur, and by smooth rotations about both tangent axes.

    ``rays`` (h, w, 3) are the viewing rays of the pixels. Normals that do not face the camera are
    invalid.
    """
    valid = truth.depth > 0
    shape = truth.depth.shape
    blurred = np.dstack([_blur(n, valid, errors.blur_px) for n in np.moveaxis(truth.normals, 2, 0)])
    length = np.linalg.norm(blurred, axis=2)
    mean = blurred / np.maximum(length, 1e-9)[..., None]
    std_tilt = np.radians(errors.std_normal_deg)
    std_tilt = std_tilt * np.exp(errors.amplitude_spread * _field(rng, shape))
    tilt = np.dstack([std_tilt * _field(rng, shape) for _ in range(3)])
    tilt -= (tilt * mean).sum(2, keepdims=True) * mean
    normals = (mean + tilt) / np.linalg.norm(mean + tilt, axis=2, keepdims=True).clip(1e-9)
    variance = std_tilt**2 + (1 - length**2).clip(0) / 2
    faces_camera = (normals * rays).sum(2) < 0
    return Prior(normals, variance * _misjudged(errors, rng, shape), valid & faces_camera)


def _misjudged(errors: PriorErrors, rng: np.random.Generator, shape: tuple[int, ...]) -> Float64:
    """Create the smooth random factor by which the declared variance deviates from the true one."""
    return np.exp(2 * errors.declared_spread * _field(rng, shape))


def _field(rng: np.random.Generator, shape: tuple[int, ...]) -> Float64:
    """Create a Gaussian random field of unit variance with several correlation lengths."""
    total = np.zeros(shape)
    for weight, share in FIELD_SCALES:
        sigma = share * shape[1]
        margin = int(3 * sigma)
        noise = rng.normal(size=(shape[0] + 2 * margin, shape[1] + 2 * margin))
        smooth = cv2.GaussianBlur(noise, (0, 0), sigma)[margin:-margin, margin:-margin]
        total += weight * 2 * np.sqrt(np.pi) * sigma * smooth
    return total


def _blur(values: Float64, valid: NDArray[np.bool_], sigma: float) -> Float64:
    """Blur the valid pixels of a map; invalid pixels become 0."""
    weight = cv2.GaussianBlur(valid.astype(float), (0, 0), sigma)
    mean = cv2.GaussianBlur(np.where(valid, values, 0), (0, 0), sigma) / weight.clip(1e-9)
    return np.where(valid, mean, 0)
