"""Options of bundle adjustment and of depth integration, with the source of each default.

``[paper ...]`` cites MP-SfM, ``[reference]`` its published code, ``[Ceres ...]`` and
``[COLMAP ...]`` an option of these libraries, ``[tuned: ...]`` the benchmark that chose the value.
"""

from __future__ import annotations

from enum import IntEnum

from mpsfm_core.data.options import Options, expert


class Loss(IntEnum):
    """Robust losses, which :mod:`mpsfm_core.optimize.losses` implements."""

    TRIVIAL = 0
    SOFT_L1 = 1
    CAUCHY = 2
    TRUNCATED = 3


class BundleOptions(Options):
    """Options of bundle adjustment. All loss scales are in standard deviations of the residual."""

    reprojection_loss: Loss = expert(Loss.CAUCHY)
    """Robust loss of reprojection errors. Errors of learned keypoints have heavier tails than the
    soft-L1 loss of the published code assumes. [tuned: benchmarks.ablation]"""
    reprojection_scale: float = expert(0.65, gt=0)
    """Scale of the reprojection loss. Raising the scale of the reprojection loss gives outliers
    more influence. [tuned: benchmarks.ablation]"""
    depth_loss: Loss = expert(Loss.CAUCHY)
    """Robust loss of log-depth errors. [paper appendix B] [reference]"""
    depth_scale: float = expert(2.0, gt=0)
    """Scale of the log-depth loss. Raising the scale of the depth loss gives wrong depth more
    influence. [reference rob_std]"""
    function_tolerance: float = expert(1e-6, ge=0)
    """Relative decrease of the cost at which bundle adjustment stops. A larger tolerance stops
    bundle adjustment earlier. [Ceres function_tolerance]"""
    max_iterations: int = expert(50, ge=1)
    """Maximum number of Levenberg-Marquardt steps, accepted or rejected. [Ceres
    max_num_iterations]"""
    dense_poses: int = expert(300, ge=0)
    """Maximum number of variable poses for a dense Cholesky factorization of the reduced camera
    system. Conjugate gradients solve systems with more poses. [tuned: benchmarks.scale]"""
    threads: int | None = expert(None, ge=1)
    """Number of threads of bundle adjustment (null uses all threads of the run). The number of
    threads does not change the result of bundle adjustment."""


SOFT_L1_OPTIONS = BundleOptions(reprojection_loss=Loss.SOFT_L1, reprojection_scale=1.5)
"""Bundle adjustment options of the published system, with soft-L1 reprojection loss. [reference]"""


class IntegrationOptions(Options):
    """Options of depth integration."""

    independent_depths: float = expert(100.0, gt=0)
    """Number of independent measurements per depth prior, whatever its resolution.

    Depth errors of neighboring pixels are correlated, so each of n pixels has the weight ``min(1,
    independent_depths / n)``. Raising ``independent_depths`` keeps the refined depth closer to the
    prior. [tuned: benchmarks.depth_integration]"""
    independent_normals: float = expert(1000.0, gt=0)
    """Number of independent measurements per normal prior, whatever its resolution. Raising
    ``independent_normals`` makes the refined depth follow the normals more closely. [tuned:
    benchmarks.depth_integration]"""
    sharpness: float = expert(2.0, gt=0)
    """Sharpness k of the soft minimum of a pixel's two one-sided normal residuals. A larger k makes
    the soft minimum closer to the smaller residual. [bilateral normal integration: 2; reference:
    1]"""
    normal_limit: float = expert(6.0, gt=0)
    """Squared residual of the surface normal above which depth may be discontinuous between two
    pixels. A larger ``normal_limit`` smooths depth discontinuities. [tuned:
    benchmarks.depth_integration]"""
    prior_scale: float = expert(1.0, gt=0)
    """Scale of the Charbonnier loss of the depth prior, in standard deviations. Raising the scale
    of the depth loss gives wrong depth priors more influence. [tuned:
    benchmarks.depth_integration]"""
    point_scale: float = expert(2.0, gt=0)
    """Scale of the Cauchy loss of sparse points, in standard deviations. Raising the scale of the
    loss gives outlier points more influence. [reference rob_std]"""
    max_iterations: int = expert(10, ge=0)
    """Maximum number of IRLS re-weightings per depth map. [reference]"""
    cg_iterations: int = expert(2, ge=1)
    """Number of conjugate-gradient iterations per IRLS re-weighting. More iterations make each IRLS
    re-weighting more exact and slower. [tuned: benchmarks.depth_integration]"""
    over_relaxation: float = expert(1.4, gt=0)
    """Factor that lengthens all IRLS steps after the first, because the majorizer gives too short
    steps for concave losses. [tuned: benchmarks.depth_integration]"""
    tolerance: float = expert(5e-2, ge=0)
    """Relative decrease of the energy at which depth integration stops. A larger tolerance stops
    depth integration earlier. [reference]"""
    max_point_growth: float = expert(1.2, ge=0)
    """Maximum increase of the sparse points' mean energy for which a depth map is not refined
    again. Raising ``max_point_growth`` skips more refinements of depth maps. [tuned:
    benchmarks.depth_integration]"""
