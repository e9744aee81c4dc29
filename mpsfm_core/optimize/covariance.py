"""Covariances of 3D points and of camera poses, and the variance of depth in a camera."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_problem import BundleProblem, prepare_bundle, range_executor
from mpsfm_core.optimize.options import BundleOptions

DAMPING = 1e-8
"""Damping of the information matrix of a point, which makes the matrix invertible. [COLMAP
damping]"""


class CalibrationStd(NamedTuple):
    """Prior standard deviations of the intrinsics of a guessed camera."""

    log_focal: float
    """Standard deviation of the log focal length, which is estimated together with the pose."""
    center_px: float
    """Standard deviation of each coordinate of the principal point, in pixels. The principal point
    is not estimated."""
    radial: float
    """Standard deviation of the coefficient k of SIMPLE_RADIAL, which is not estimated."""


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
    fixed = replace(
        problem, variable_pose=no_pose, variable_scale=None, scale_anchor=None, rig=None
    )
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


def compute_pose_covariance(
    pose: Pose,
    intrinsics: Float64,
    points: Float64,
    point_covariances: Float64,
    std_px: Float64,
    calibration: CalibrationStd | None = None,
    point_shifts: Float64 | None = None,
) -> Float64:
    """Compute the covariance of a camera pose from observed points of uncertain position.

    The covariance is the inverse of ``sum(J^T S^-1 J)`` with the Jacobian ``J`` of a projection
    and ``S = std_px^2 I + P C P^T``, where ``P`` is the Jacobian of the projection with respect to
    the point and ``C`` the covariance of the point. Errors that are not estimated (of intrinsics,
    or shared by several points) are propagated to the pose (consider covariance, Schmidt 1966).

    Args:
        pose: ``cam_from_world``.
        intrinsics: (4,) camera parameters fx, fy, cx, cy in pixels.
        points: (m, 3) observed points in the world frame.
        point_covariances: (m, 3, 3) covariances of the points without the observations of this
            camera, in squared world units.
        std_px: (m,) standard deviation of the observations in pixels.
        calibration: Uncertainty of a guessed camera, or None for a known camera.
        point_shifts: (m, 3, k) shifts of the points in world units by one standard deviation of
            each of k errors that move several points.

    Returns:
        (6, 6) covariance of ``w`` and ``dt`` in ``R <- exp(w) R, t <- t + dt``, in radians and
        world units. The covariance is infinite if the observations do not determine the pose.
    """
    rotation, translation = pose
    turned = points @ rotation.T
    x, y, z = (turned + translation).T
    fx, fy = intrinsics[:2]
    zero = np.zeros_like(z)
    projection = np.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], axis=1)
    projection = projection.reshape(-1, 2, 3)
    a, b, c = turned.T
    rotating = np.stack([zero, c, -b, -c, zero, a, b, -a, zero], axis=1).reshape(-1, 3, 3)
    rays = np.stack([x / z, y / z], axis=1)
    zooming = (intrinsics[:2] * rays)[..., None]
    jacobian = np.concatenate([projection @ rotating, projection, zooming], axis=2)
    moving = projection @ rotation
    noise = moving @ point_covariances @ moving.transpose(0, 2, 1)
    noise += std_px[:, None, None] ** 2 * np.eye(2)
    weighted = np.linalg.solve(noise, jacobian).transpose(0, 2, 1)
    information = (weighted @ jacobian).sum(axis=0)
    systematic = [np.zeros((len(z), 2, 0)) if point_shifts is None else moving @ point_shifts]
    if calibration is None:
        covariance = _invert(information[:6, :6])
    else:
        information[6, 6] += 1.0 / calibration.log_focal**2
        covariance = _invert(information)
        systematic.append(np.broadcast_to(calibration.center_px * np.eye(2), (len(z), 2, 2)))
        bending = calibration.radial * (rays**2).sum(axis=1)
        systematic.append(bending[:, None, None] * zooming)
    weighted = weighted[:, : len(covariance)]
    errors = covariance @ (weighted @ np.concatenate(systematic, axis=2)).sum(axis=0)
    total: Float64 = covariance + errors @ errors.T
    return total[:6, :6]


def _invert(information: Float64) -> Float64:
    """Invert an information matrix, and return infinite covariances if it is singular."""
    try:
        return np.asarray(np.linalg.inv(information), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full_like(information, np.inf)
