"""Measurement of the keypoint noise, which decides between normal and heavy-tailed errors.

A normal and a Student's t distribution of the epipolar errors of matches are compared by their
likelihood. If the keypoint errors are normally distributed, a loss near least squares is
statistically efficient. If the keypoint errors have heavy tails, as often for learned keypoints,
the Cauchy loss of the options is used. A Cauchy loss of scale ``c`` is the likelihood of Student's
t distribution with ``nu`` degrees of freedom and scale ``s``, ``c^2 = nu s^2``.

Reprojection errors would give a biased estimate of the keypoint noise, because a robustly fitted
point passes through some of its keypoints. Epipolar errors do not depend on 3D points, but only on
poses.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import erf

from mpsfm_core.data import Float64, Int64
from mpsfm_core.mapping.scene.scene import Scene

MAX_MATCHES = 4000
"""Maximum number of evenly spaced matches that measure the keypoint noise. [ours]"""
MIN_MATCHES = 100
"""Minimum number of matches for a measurement of the keypoint noise. With fewer than
``MIN_MATCHES`` matches, the reprojection loss of the options applies. [ours]"""
MAX_RESIDUAL = 4.0
"""Maximum epipolar error in standard deviations of the keypoint position. Matches with an epipolar
error above ``MAX_RESIDUAL`` are outliers. [COLMAP filter_max_reproj_error]"""
EFFICIENT_SCALE = 3.644
"""Scale of the Cauchy loss with 98 % efficiency for normal errors, in standard deviations of the
keypoint position (Holland and Welsch, Communications in Statistics A6, 1977). [tuned:
benchmarks.everyday]"""
DEGREES_OF_FREEDOM = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0])
"""Candidate degrees of freedom of the Student's t distribution that fits the epipolar errors."""


def measure_loss_scale(scene: Scene, default_scale: float) -> float:
    """Measure the scale of the Cauchy loss that fits the matches of registered images.

    Args:
        scene: The scene.
        default_scale: Scale of the Cauchy loss for heavy-tailed errors or too few matches.

    Returns:
        Scale of the Cauchy loss in standard deviations of the keypoint position, at least
        ``default_scale``.
    """
    residuals = compute_epipolar_residuals(scene)
    if len(residuals) < MIN_MATCHES:
        return default_scale
    std = float(np.sqrt((residuals**2).mean()))
    normal = compute_normal_log_likelihood(residuals, std)
    if normal > compute_student_log_likelihood(residuals, default_scale):
        return max(default_scale, EFFICIENT_SCALE * std)
    return default_scale


def compute_normal_log_likelihood(residuals: Float64, std: float) -> float:
    """Compute the mean log likelihood of Sampson errors under a truncated normal distribution.

    Args:
        residuals: (m,) float64 Sampson errors below ``MAX_RESIDUAL``.
        std: Standard deviation of the truncated normal distribution.
    """
    norm = std * np.sqrt(np.pi / 2) * erf(MAX_RESIDUAL / (std * np.sqrt(2)))
    return float(-0.5 * (residuals**2).mean() / std**2 - np.log(norm))


def compute_student_log_likelihood(residuals: Float64, scale: float) -> float:
    """Compute the mean log likelihood of Sampson errors under the best truncated t distribution.

    Args:
        residuals: (m,) float64 Sampson errors below ``MAX_RESIDUAL``.
        scale: Scale of the Cauchy loss that corresponds to the Student's t distribution.
    """
    spread = np.log1p((residuals / scale) ** 2).mean()
    return float((-(DEGREES_OF_FREEDOM + 1) / 2 * spread - _log_norms(scale)).max())


def compute_epipolar_residuals(scene: Scene) -> Float64:
    """Compute the Sampson errors (m,) of matches of registered images, without outliers.

    Sampson errors are in standard deviations of the keypoint position.
    """
    source, target = _sample_matches(scene)
    centers, images = scene.centers(), scene.graph.image_of
    baseline = centers[images[target]] - centers[images[source]]
    ray_a, ray_b = scene.world_rays(source), scene.world_rays(target)
    error = np.einsum("na,na->n", ray_a, np.cross(baseline, ray_b))
    variance = _propagate_variance(scene, source, np.cross(baseline, ray_b))
    variance += _propagate_variance(scene, target, np.cross(ray_a, baseline))
    residuals: Float64 = np.abs(error) / np.sqrt(np.maximum(variance, 1e-300))
    return residuals[residuals < MAX_RESIDUAL]


def _sample_matches(scene: Scene) -> tuple[Int64, Int64]:
    """Return the two keypoints of each match between registered images, each match once."""
    graph = scene.graph
    is_used = scene.registered[graph.image_of[graph.source]]
    is_used &= scene.registered[graph.image_of[graph.target]] & (graph.source < graph.target)
    rows = np.flatnonzero(is_used)
    rows = rows[:: len(rows) // MAX_MATCHES + 1]
    return graph.source[rows], graph.target[rows]


def _propagate_variance(scene: Scene, keypoints: Int64, normals: Float64) -> Float64:
    """Propagate the keypoint noise to the variance (m,) of ``ray . normal``."""
    images = scene.graph.image_of[keypoints]
    local = np.einsum("nij,nj->ni", scene.rotations[images], normals)
    slope = local[:, :2] / scene.intrinsics[images, :2]
    variance: Float64 = (slope**2).sum(axis=1) * scene.keypoint_std_px[images] ** 2
    return variance


@cache
def _log_norms(scale: float) -> Float64:
    """Return the log integrals of the truncated t distributions (midpoint rule)."""
    num_steps = 4000
    residuals = (np.arange(num_steps) + 0.5) * MAX_RESIDUAL / num_steps
    log_densities = np.log1p((residuals[:, None] / scale) ** 2) * -(DEGREES_OF_FREEDOM + 1) / 2
    norms: Float64 = np.log(np.exp(log_densities).sum(axis=0) * MAX_RESIDUAL / num_steps)
    return norms
