"""Covariances of 3D points, and what they say about depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_problem import BundleProblem, prepare_bundle, range_executor
from mpsfm_core.optimize.options import BundleOptions

DAMPING = 1e-8
"""Added to the information of each coordinate, so that it has an inverse (COLMAP's default)."""


def compute_point_covariances(
    problem: BundleProblem, options: BundleOptions | None = None
) -> Float64:
    """Covariance of each point for fixed cameras: (p, 3, 3) float64, world frame, squared units.

    The inverse of the point's block of the normal equations, with the weights of the robust
    losses, which is what COLMAP's ``estimate_ba_covariance`` gives for points. Observations that
    do not project count nothing. A direction that nothing observes has variance
    1 / :data:`DAMPING`. What is variable in the problem does not matter.

    Raises:
        DataError: as :func:`~mpsfm_core.optimize.bundle_adjustment.adjust_bundle`.
    """
    options = options or BundleOptions()
    nothing = np.zeros(len(problem.rotations), dtype=np.bool_)
    held = replace(problem, variable_pose=nothing, variable_scale=None, scale_anchor=None)
    p = prepare_bundle(held, options)
    covariances = np.empty((len(p.state.points), 3, 3))
    scratch = [kernels.allocate_buffers(0) for _ in p.ranges]
    with range_executor(p.ranges, options.threads) as run:
        run(
            lambda n, first, last: kernels.invert_point_blocks(
                first, last, DAMPING, p.bundle, p.state, scratch[n], covariances
            )
        )
    return covariances


def propagate_depth_variance(covariances: Float64, rotations: Float64) -> Float64:
    """Variance of the depth z of points in a camera: (m,) float64, squared units.

    ``covariances``: (m, 3, 3), world frame. ``rotations``: (m, 3, 3) or (3, 3), of
    cam_from_world. This is the last diagonal entry of R S R^T (the published code has R^T S R).
    """
    axis = rotations[..., 2, :]
    variance: Float64 = np.einsum("...a,...ab,...b->...", axis, covariances, axis)
    return variance
