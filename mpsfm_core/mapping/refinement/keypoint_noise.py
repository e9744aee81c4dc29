"""How keypoints err in this scene, measured by how matches meet: clean, or with heavy tails.

Two explanations compete for the distances of matches from meeting. Keypoints are *clean*: errors
are normal, and a loss near least squares uses them best. Or they have *tails*, as learned ones do,
of which the loss of the options knows: Cauchy's loss of scale ``c`` is the likelihood of Student's
t distribution with ``c^2 = nu s^2``, ``nu`` its degrees of freedom and ``s`` the std of its core.
The likelier one counts.

Residuals of points would tell wrong: a robust fit of a point passes through some of its keypoints,
and looks the more exact the smaller the scale is. So matches are held against their epipolar
lines, which hang on the poses alone.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import erf

from mpsfm_core.data import Float64, Int64
from mpsfm_core.mapping.scene.scene import Scene

MAX_MATCHES = 4000
"""That are looked at, evenly spaced: a std is known within 1 % then (ours)."""
MIN_MATCHES = 100
"""Fewer say too little of tails: the loss stays as it is (ours)."""
MAX_RESIDUAL = 4.0
"""Stds of a keypoint beyond which bundle adjustment sees no residual, as observations that are
farther from their point are filtered (COLMAP)."""
EFFICIENT = 3.644
"""Scale of Cauchy's loss in stds of normal errors of both coordinates at which it is as good as
least squares on 98 % of the observations (2.549 for 95 %; Holland and Welsch, Communications in
Statistics A6, 1977, have 2.385 for errors of one coordinate). Ours: at 2.385 200 views of a hall
reach 92.2 at 1 degree, at 3.644 92.5, COLMAP's least squares 92.9. Wrong matches are no reason for
less: they are filtered at :data:`MAX_RESIDUAL`."""
FREEDOMS = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0])
"""Degrees of freedom that are tried for the tails."""


def measure_loss_scale(scene: Scene, scale: float) -> float:
    """Scale of Cauchy's loss, in stds of a keypoint, that suits the matches of registered images.

    ``scale``: that for keypoints with tails, or where too few matches tell.
    """
    residuals = compute_epipolar_residuals(scene)
    if len(residuals) < MIN_MATCHES:
        return scale
    std = float(np.sqrt((residuals**2).mean()))
    if compute_normal_log_likelihood(residuals, std) > compute_student_log_likelihood(
        residuals, scale
    ):
        return max(scale, EFFICIENT * std)
    return scale


def compute_normal_log_likelihood(residuals: Float64, std: float) -> float:
    """Mean log likelihood of residuals (m,) below :data:`MAX_RESIDUAL`, were they normal."""
    norm = std * np.sqrt(np.pi / 2) * erf(MAX_RESIDUAL / (std * np.sqrt(2)))
    return float(-0.5 * (residuals**2).mean() / std**2 - np.log(norm))


def compute_student_log_likelihood(residuals: Float64, scale: float) -> float:
    """The same for the t distribution of that scale, with the best degrees of freedom."""
    spread = np.log1p((residuals / scale) ** 2).mean()
    return float((-(FREEDOMS + 1) / 2 * spread - _log_norms(scale)).max())


def compute_epipolar_residuals(scene: Scene) -> Float64:
    """(m,) distances of matches of registered images from meeting, in stds of a keypoint.

    To first order how far both keypoints of a match must move for their rays to meet (Sampson).
    """
    source, target = _some_matches(scene)
    centers, images = scene.centers(), scene.graph.image_of
    baseline = centers[images[target]] - centers[images[source]]
    ray_a, ray_b = scene.world_rays(source), scene.world_rays(target)
    gap = np.einsum("na,na->n", ray_a, np.cross(baseline, ray_b))
    variance = _variance_of_gap(scene, source, np.cross(baseline, ray_b))
    variance += _variance_of_gap(scene, target, np.cross(ray_a, baseline))
    residuals: Float64 = np.abs(gap) / np.sqrt(np.maximum(variance, 1e-300))
    return residuals[residuals < MAX_RESIDUAL]


def _some_matches(scene: Scene) -> tuple[Int64, Int64]:
    """Keypoints of matches of registered images, each match once."""
    graph = scene.graph
    both = scene.registered[graph.image_of[graph.source]]
    both &= scene.registered[graph.image_of[graph.target]] & (graph.source < graph.target)
    rows = np.flatnonzero(both)
    rows = rows[:: len(rows) // MAX_MATCHES + 1]
    return graph.source[rows], graph.target[rows]


def _variance_of_gap(scene: Scene, keypoints: Int64, normals: Float64) -> Float64:
    """(m,) variance of ``ray * normal`` from the noise of the ray's keypoint."""
    images = scene.graph.image_of[keypoints]
    local = np.einsum("nij,nj->ni", scene.rotations[images], normals)
    slope = local[:, :2] / scene.intrinsics[images, :2]
    variance: Float64 = (slope**2).sum(axis=1) * scene.keypoint_std_px[images] ** 2
    return variance


@cache
def _log_norms(scale: float) -> Float64:
    """(freedoms,) logarithm of the integral of each distribution's shape."""
    steps = 4000
    residuals = (np.arange(steps) + 0.5) * MAX_RESIDUAL / steps
    shapes = np.log1p((residuals[:, None] / scale) ** 2) * -(FREEDOMS + 1) / 2
    norms: Float64 = np.log(np.exp(shapes).sum(axis=0) * MAX_RESIDUAL / steps)
    return norms
