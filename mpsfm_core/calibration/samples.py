"""Samples of prior and true depth or normals, and the errors to which the std is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, Int64, NormalPrior
from mpsfm_core.geometry import (
    angle_between_deg,
    log_depth_steps,
    sample_bilinear,
    sample_nearest,
    scale_pixels,
)
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, depth_medians

MIN_SAMPLES = 20
"""Minimum number of samples to estimate the scale of an image [ours]."""
GROSS_DEPTH = float(np.log(4))
"""Maximum error of log depth, the range of the uniform density of gross errors [ours]."""
GROSS_NORMAL = float(np.pi / 2)
"""Maximum error of a normal in rad, the range of the uniform density of gross errors."""


@dataclass(frozen=True, eq=False)
class DepthTruth:
    """True depth at n pixels of a view."""

    xy: Float64
    """(n, 2) float64 positions of the samples, COLMAP pixels of the view."""
    depth: Float64
    """(n,) float64 true z-depth, positive."""
    std: Float64
    """(n,) float64 std of the true log depth; 0 if exact."""


@dataclass(frozen=True, eq=False)
class NormalTruth:
    """True normals at n pixels of a view."""

    xy: Float64
    """(n, 2) float64 positions of the samples, COLMAP pixels of the view."""
    normals: Float64
    """(n, 3) true unit normals, camera frame."""
    std: Float64
    """(n,) std of the true normals in rad along each tangent direction."""


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """Prior and true depth at n pixels of one image."""

    name: str
    """Name of the image."""
    prior: Float64
    """(n,) prior depth in the unit of the network."""
    network_std: Float64 | None
    """(n,) depth std that the network predicts, or None without prediction."""
    step: Float64
    """(n,) maximum difference of log depth to the four neighboring pixels."""
    truth: Float64
    """(n,) true depth at the sampled pixels."""
    truth_std: Float64
    """(n,) std of the true log depth."""
    depth_medians: tuple[float, float]
    """Medians of depth and of inverse depth over the prior's depth map."""
    metric: bool
    """True if the prior depth is in meters."""


@dataclass(frozen=True, eq=False)
class NormalSamples:
    """Predicted and true normals at n pixels of one image."""

    name: str
    """Name of the image."""
    prior: Float64
    """(n, 3) unit normals of the prior, camera frame."""
    network_std: Float64 | None
    """(n,) normal std in rad that the network predicts, or None without prediction."""
    truth: Float64
    """(n, 3) true unit normals of the samples, camera frame."""
    truth_std: Float64
    """(n,) std of the true normals in rad."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Errors of a prior at n pixels, with the m terms of their std ``max_j(theta_j * term_j)``."""

    error: Float64
    """(n,) errors of log depth, or of a normal along one tangent direction in rad."""
    noise: Float64
    """(n,) std of the true value in the unit of ``error``."""
    terms: Float64
    """(n, m) terms ``term_j`` of the modeled std."""
    names: tuple[str, ...]
    """(m,) names of the std factors ``theta_j``."""
    step: Float64
    """(n,) maximum difference of log depth to the four neighboring pixels; 0 for normals."""
    image: Int64
    """(n,) index of the image of each sample."""
    magnitude: Float64
    """(n,) absolute depth error in meters or normal error in rad."""
    unit: Float64
    """(n,) factor that converts the modeled std to the unit of ``magnitude``."""
    place: Float64
    """(n,) quantity (depth, or slant in degrees) by which the report groups errors."""
    images: int
    """Number of images."""
    limit: float
    """Maximum error in the unit of ``error``, at which larger errors are clipped."""
    scales: Float64
    """(images,) log of the depth scale of each image; empty for normals."""

    def __len__(self) -> int:
        return len(self.error)

    def weights(self) -> Float64:
        """Return weights (n,) of the samples, the inverse number of samples of their image."""
        return 1.0 / np.bincount(self.image, minlength=self.images)[self.image]


def concatenate_residuals(parts: Sequence[Residuals]) -> Residuals:
    """Concatenate the prior errors of disjoint groups of images."""
    names = ("error", "noise", "terms", "step", "magnitude", "unit", "place", "scales")
    arrays: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in names}
    firsts = np.cumsum([0, *(part.images for part in parts)])
    image = np.concatenate([p.image + first for p, first in zip(parts, firsts, strict=False)])
    return replace(parts[0], image=image, images=int(firsts[-1]), **arrays)


def compare_depth(
    name: str, prior: DepthPrior, size: tuple[int, int], truth: DepthTruth
) -> DepthSamples | None:
    """Sample a depth prior bilinearly at pixels with true depth.

    Args:
        name: Name of the image.
        prior: Depth prior.
        size: (width, height) of the view in pixels.
        truth: True depth.

    Returns:
        The depth samples, or None with fewer than :data:`MIN_SAMPLES` valid samples.
    """
    xy = scale_pixels(truth.xy, size, (prior.shape[1], prior.shape[0]))
    depth, ok = sample_bilinear(prior.depth, prior.valid, xy)
    if ok.sum() < MIN_SAMPLES:
        return None
    network_std = None
    if prior.variance is not None:
        network_std = sample_bilinear(np.sqrt(prior.variance), prior.valid, xy)[0][ok]
    step = sample_nearest(log_depth_steps(prior.depth, prior.valid), xy)[ok]
    return DepthSamples(
        name,
        depth[ok],
        network_std,
        step.astype(np.float64),
        truth.depth[ok],
        truth.std[ok],
        depth_medians(prior),
        prior.metric,
    )


def compare_normals(
    name: str, prior: NormalPrior, size: tuple[int, int], truth: NormalTruth
) -> NormalSamples | None:
    """Sample a normal prior at pixels with true normals; the nearest prior pixel is used."""
    xy = scale_pixels(truth.xy, size, (prior.shape[1], prior.shape[0]))
    ok = sample_nearest(prior.valid, xy)
    if ok.sum() < MIN_SAMPLES:
        return None
    network_std = None
    if prior.variance is not None:
        network_std = np.sqrt(sample_nearest(prior.variance, xy)[ok].astype(np.float64))
    normals = sample_nearest(prior.normals, xy)[ok].astype(np.float64)
    return NormalSamples(name, normals, network_std, truth.normals[ok], truth.std[ok])


def depth_residuals(
    samples: Sequence[DepthSamples], model: DepthCalibration, *, scaled: bool = True
) -> Residuals:
    """Compute errors of log depth after the shift and, if `scaled`, after scaling each image.

    The scale of an image is the median ratio of true to prior depth, as in the mapper.
    """
    network = all(image.network_std is not None for image in samples)
    parts, scales = [], []
    for number, image in enumerate(samples):
        shifted, gain, ok = model.shift_depth(image.prior, image.depth_medians)
        depth, gain = shifted[ok], gain[ok]
        log_ratio = np.log(image.truth[ok] / depth)
        scale = float(np.median(log_ratio)) if ok.any() else 0.0
        scales.append(scale)
        error = log_ratio - (scale if scaled else 0.0)
        unit = depth * np.exp(scale if scaled else 0.0)
        terms = [np.ones(len(depth))]
        if network and image.network_std is not None:
            terms.insert(0, image.network_std[ok] * gain / depth)
        if image.metric:
            terms.append(1 / depth)
        truth, noise = image.truth[ok], image.truth_std[ok]
        magnitude = np.abs(truth - unit)
        columns = (error, noise, image.step[ok], magnitude, unit, truth)
        parts.append((np.stack(columns), np.stack(terms, axis=1), np.full(len(depth), number)))
    names = ("std_scale",) * network + ("relative_std",) + ("std_floor",) * samples[0].metric
    return _build_residuals(parts, names, GROSS_DEPTH, np.array(scales))


def normal_residuals(samples: Sequence[NormalSamples]) -> Residuals:
    """Compute errors of normals in rad along both tangent directions, two errors per pixel."""
    network = all(image.network_std is not None for image in samples)
    parts = []
    for number, image in enumerate(samples):
        error = tangent_errors(image.prior, image.truth)
        terms = [np.ones(len(image.prior))]
        if network and image.network_std is not None:
            terms.insert(0, image.network_std)
        slant = angle_between_deg(-image.prior, np.array([0.0, 0.0, 1.0]))
        angle = np.linalg.norm(error, axis=1)
        ones = np.ones(len(error))
        for component in error.T:
            columns = (component, image.truth_std, 0 * ones, angle, ones, slant)
            parts.append((np.stack(columns), np.stack(terms, axis=1), np.full(len(ones), number)))
    names = ("std_scale",) * network + ("std_floor_deg",)
    return _build_residuals(parts, names, GROSS_NORMAL, np.zeros(0))


def tangent_errors(prior: Float64, truth: Float64) -> Float64:
    """Compute the tangent vectors from predicted to true normals.

    Args:
        prior: (n, 3) predicted unit normals.
        truth: (n, 3) true unit normals.

    Returns:
        (n, 2) errors in rad along two orthogonal tangent directions; the norm is the angle between
        the normals.
    """
    first = np.cross(prior, np.array([0.0, 1.0, 0.0]))
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(prior, first)
    across = np.stack([(truth * first).sum(axis=1), (truth * second).sum(axis=1)], axis=1)
    angle = np.radians(angle_between_deg(prior, truth))
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    errors: Float64 = across * (angle / length)[:, None]
    return errors


def _build_residuals(
    parts: list[tuple[Float64, Float64, Int64]],
    names: tuple[str, ...],
    limit: float,
    scales: Float64,
) -> Residuals:
    error, noise, step, magnitude, unit, place = np.concatenate([p[0] for p in parts], axis=1)
    terms = np.concatenate([p[1] for p in parts])
    image = np.concatenate([p[2] for p in parts]).astype(np.int64)
    images = int(image.max()) + 1
    error = np.clip(error, -limit, limit)
    return Residuals(
        error, noise, terms, names, step, image, magnitude, unit, place, images, limit, scales
    )
