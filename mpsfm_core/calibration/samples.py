"""A prior beside the truth: what is compared, and the errors that a calibration is fitted to."""

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
"""An image with fewer says nothing about its scale and is left out (ours)."""
GROSS_DEPTH = float(np.log(4))
GROSS_NORMAL = float(np.pi / 2)
"""Largest errors of log depth and of a normal's direction, for the density of gross errors: a
factor of 4 is no estimate any more (ours)."""


@dataclass(frozen=True, eq=False)
class DepthTruth:
    """True depth z at some pixels of a view.

    ``xy``: (n, 2) float64, COLMAP pixels of the view. ``depth``: (n,) float64, > 0. ``std``: (n,)
    float64, of the log of the true depth, 0 where it is exact.
    """

    xy: Float64
    depth: Float64
    std: Float64


@dataclass(frozen=True, eq=False)
class NormalTruth:
    """True normals (n, 3), unit, camera frame, at pixels ``xy`` (n, 2) of a view; ``std``: (n,)
    rad, along each of the two tangent directions."""

    xy: Float64
    normals: Float64
    std: Float64


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """Prior and true depth at ``n`` pixels of one image; all (n,) float64.

    ``network_std`` is None when the network gives none. ``step``: largest step of log depth to a
    neighbour. ``depth_medians``: of depth and of inverse depth over the prior's map.
    """

    name: str
    prior: Float64
    network_std: Float64 | None
    step: Float64
    truth: Float64
    truth_std: Float64
    depth_medians: tuple[float, float]
    metric: bool


@dataclass(frozen=True, eq=False)
class NormalSamples:
    """Predicted and true normals (n, 3) at ``n`` pixels of one image; stds (n,) in rad."""

    name: str
    prior: Float64
    network_std: Float64 | None
    truth: Float64
    truth_std: Float64


@dataclass(frozen=True, eq=False)
class Residuals:
    """Errors of a prior and what their std may be made of; all (n,) float64 but where said.

    ``error``: of log depth, or of a normal along one tangent direction in rad. ``noise``: std of
    the truth in the same unit. ``terms``: (n, m), the std is ``max_j(theta_j * terms_j)``;
    ``names``: of the ``theta_j``. ``step``: of log depth beside the pixel, 0 for normals.
    ``image``: (n,) int64. ``magnitude``: the error as a user sees it (metres, rad), and ``unit``:
    what turns a std into it. ``place``: what errors are broken down by (depth; slant in degrees).
    ``images``: number of images. ``limit``: largest error; those beyond are as gross as it.
    ``scales``: log of each image's scale, empty for normals.
    """

    error: Float64
    noise: Float64
    terms: Float64
    names: tuple[str, ...]
    step: Float64
    image: Int64
    magnitude: Float64
    unit: Float64
    place: Float64
    images: int
    limit: float
    scales: Float64

    def __len__(self) -> int:
        return len(self.error)

    def weights(self) -> Float64:
        """(n,), 1 / the number of samples of the image: every image counts the same."""
        return 1.0 / np.bincount(self.image, minlength=self.images)[self.image]


def concatenate_residuals(parts: Sequence[Residuals]) -> Residuals:
    """Residuals of different images as one."""
    names = ("error", "noise", "terms", "step", "magnitude", "unit", "place", "scales")
    arrays: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in names}
    firsts = np.cumsum([0, *(part.images for part in parts)])
    image = np.concatenate([p.image + first for p, first in zip(parts, firsts, strict=False)])
    return replace(parts[0], image=image, images=int(firsts[-1]), **arrays)


def compare_depth(
    name: str, prior: DepthPrior, size: tuple[int, int], truth: DepthTruth
) -> DepthSamples | None:
    """Sample the prior of a view of ``size`` (width, height) where the truth is known.

    Bilinear, as the mapper does at keypoints. None when fewer than :data:`MIN_SAMPLES` are valid.
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
    """Take the prior's nearest pixel where the truth is known; None as :func:`compare_depth`."""
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
    """Errors of log depth after the model's shift and, if ``scaled``, each image's own scale.

    The scale of an image is the median ratio of truth to prior, as in the mapper.
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
    return _joined(parts, names, GROSS_DEPTH, np.array(scales))


def normal_residuals(samples: Sequence[NormalSamples]) -> Residuals:
    """Errors of normals along both tangent directions, in rad; each pixel counts twice."""
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
    return _joined(parts, names, GROSS_NORMAL, np.zeros(0))


def tangent_errors(prior: Float64, truth: Float64) -> Float64:
    """Where the true normals (n, 3) lie as seen from the predicted ones: (n, 2) rad, along two
    orthogonal tangent directions; the length is the angle between them."""
    first = np.cross(prior, np.array([0.0, 1.0, 0.0]))
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(prior, first)
    across = np.stack([(truth * first).sum(axis=1), (truth * second).sum(axis=1)], axis=1)
    angle = np.radians(angle_between_deg(prior, truth))
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    errors: Float64 = across * (angle / length)[:, None]
    return errors


def _joined(
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
