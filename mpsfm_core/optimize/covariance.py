"""Covariances of 3D points, and the variance of their depth in a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_problem import BundleProblem, prepare_bundle, range_executor
from mpsfm_core.optimize.options import BundleOptions

DAMPING = 1e-8
"""Damping of the information matrix of a point, which makes the matrix invertible. [COLMAP
damping]"""


def compute_point_covariances(
    problem: BundleProblem, options: BundleOptions | None = None
) -> Float64:
    """Compute the covariance of each point for fixed cameras.

    The covariance is the inverse of the block of the point in the normal equations, with the IRLS
    weights of the robust losses, as in COLMAP's ``estimate_ba_covariance``. Directions that no
    image observes have the variance ``1 / DAMPING``.

    Args:
        problem: Bundle adjustment problem, whose points are all treated as variable.
        options: Options of bundle adjustment with the robust losses and the number of threads.

    Returns:
        (p, 3, 3) float64 covariances in the world frame, in squared world units.

    Raises:
        DataError: See :func:`~mpsfm_core.optimize.bundle_adjustment.adjust_bundle`.
    """
    options = options or BundleOptions()
    no_pose = np.zeros(len(problem.rotations), dtype=np.bool_)
    fixed = replace(problem, variable_pose=no_pose, variable_scale=None, scale_anchor=None)
    p = prepare_bundle(fixed, options)
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
    """Propagate the covariances of points to the variance of their depth in a camera.

    The variance is the last diagonal entry of ``R S R^T``, whereas the published code uses ``R^T S
    R``.

    Args:
        covariances: (m, 3, 3) covariances S in the world frame, in squared world units.
        rotations: (m, 3, 3) or (3, 3) rotation R of ``cam_from_world``.

    Returns:
        (m,) float64 variance of the depth z in squared world units.
    """
    axis = rotations[..., 2, :]
    variance: Float64 = np.einsum("...a,...ab,...b->...", axis, covariances, axis)
    return variance
