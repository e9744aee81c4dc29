"""Refinement of a camera pose from keypoints and 3D points of uncertain depth.

Each keypoint matches a keypoint in a registered image. The 3D point of the match lies on a segment
of the viewing ray in the registered image, between a minimum and maximum depth. If the 3D point is
known, both ends of the segment are equal. IRLS with Gauss-Newton steps ``R <- exp(w) R, t <- t +
dt`` minimizes Tukey's biweight loss of the distances between keypoints and projected segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.optimize.bundle_kernels import MIN_DEPTH, rotation_from_vector
from mpsfm_core.support import jit

DAMPING = 1e-6
"""Relative damping of the normal equations of pose refinement, against singularity. [ours]"""
MAX_TURN = 1.0
"""Maximum rotation of a Gauss-Newton step in radians. Larger rotations result from matches that do
not constrain the pose. [ours]"""


class RaySegments(NamedTuple):
    """Keypoints of an image, and 3D segments that contain their 3D points."""

    near: Float64
    """(m, 3) near end of each segment in the world frame."""
    far: Float64
    """(m, 3) far end of each segment in the world frame."""
    xy: Float64
    """(m, 2) keypoints in pixels of the image."""
    limit: Float64
    """(m,) distance in pixels between keypoint and projected segment above which a match has no
    influence."""
    weight: Float64
    """(m,) weight of each match in the objective."""


class FrameImage(NamedTuple):
    """Image of a frame of a rig, whose relative pose to the refined camera is constant."""

    relative_pose: Pose
    """Pose ``image_from_camera`` of the image relative to the refined camera, which is the identity
    for the refined camera."""
    intrinsics: Float64
    """(4,) camera parameters fx, fy, cx, cy in pixels."""
    segments: RaySegments
    """Keypoints of the image, and their segments."""


class _NearestPoint(NamedTuple):
    """Point of a projected 3D segment that is nearest to the keypoint.

    The fields ``near`` and ``far`` are the segment's ends in the camera frame, and ``near_q`` and
    ``far_q`` are these ends without the translation. The field ``share`` in [0, 1] is the position
    of the nearest point between the projected ends. The vector ``(du, dv)`` is the residual in
    pixels. The vector ``(au, av)`` is the direction of the projected segment, or 0 if an end is
    nearest.
    """

    visible: bool
    near: tuple[float, float, float]
    near_q: tuple[float, float, float]
    far: tuple[float, float, float]
    far_q: tuple[float, float, float]
    share: float
    du: float
    dv: float
    au: float
    av: float


POSE = np.int64(6)
"""Number of parameters of a pose, 3 for rotation and 3 for translation."""
_kernel, _helper = jit.kernel(), jit.helper()


def measure_segments(
    pose: Pose, intrinsics: Float64, segments: RaySegments
) -> tuple[Float64, Float64]:
    """Measure distances between keypoints and projected ray segments.

    A ray segment is the part of a keypoint's ray in another image within its depth interval.

    Args:
        pose: ``cam_from_world``.
        intrinsics: (4,) camera parameters fx, fy, cx, cy in pixels.
        segments: Keypoints and segments.

    Returns:
        Distances (m,) in pixels and depths (m,) of the nearest points on the segments. Distance and
        depth are NaN if an end of the segment is behind the camera.
    """
    distances, depths = np.empty((2, len(segments.xy)))
    rotation, translation = map(np.ascontiguousarray, pose)
    _measure(rotation, translation, intrinsics, segments, distances, depths)
    return distances, depths


def refine_pose(
    pose: Pose, images: Sequence[FrameImage], *, scales: Float64
) -> tuple[Float64, Float64]:
    """Refine a camera pose by one Gauss-Newton step per scale of the distance limits.

    A rotation ``exp(w)`` of the camera is a rotation ``exp(R w)`` of an image with the relative
    pose ``(R, t)``, and a shift ``dt`` of the camera is a shift ``R dt`` of the image.

    Args:
        pose: Initial ``cam_from_world``.
        images: Images of the camera's frame, whose keypoints determine the pose.
        scales: Factors on the distance limits, the largest first (graduated non-convexity).

    Returns:
        The refined pose, or the last valid pose if the matches do not constrain the pose.
    """
    rotation, translation = map(np.ascontiguousarray, pose)
    derivatives = [
        np.kron(np.eye(2), image.relative_pose[0]).astype(np.float64) for image in images
    ]
    for scale in scales:
        matrix, vector = _linearize_frame(rotation, translation, images, derivatives, scale)
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            break
        step = -np.linalg.solve(matrix + np.diag(DAMPING * diagonal), vector)
        if not np.linalg.norm(step[:3]) < MAX_TURN:
            break
        rotation = np.array(rotation_from_vector(step[0], step[1], step[2])) @ rotation
        translation = translation + step[3:]
    return rotation, translation


def _linearize_frame(
    rotation: Float64,
    translation: Float64,
    images: Sequence[FrameImage],
    derivatives: Sequence[Float64],
    scale: float,
) -> tuple[Float64, Float64]:
    """Sum the Gauss-Newton matrices (6, 6) and gradients (6,) of the images of a frame.

    Args:
        rotation: (3, 3) ``cam_from_world``.
        translation: (3,) ``cam_from_world``.
        images: Images of the frame.
        derivatives: Derivative (6, 6) of the pose of each image by the pose of the camera.
        scale: Factor on the distance limits.
    """
    matrix, gradient = np.zeros((POSE, POSE)), np.zeros(POSE)
    of_image, vector = np.empty((POSE, POSE)), np.empty(POSE)
    for ((turn, shift), intrinsics, segments), derivative in zip(images, derivatives, strict=True):
        linearize_pose(
            turn @ rotation,
            turn @ translation + shift,
            intrinsics,
            segments,
            scale,
            of_image,
            vector,
        )
        matrix += derivative.T @ of_image @ derivative
        gradient += derivative.T @ vector
    return matrix, gradient


@_kernel
def linearize_pose(
    rotation: Float64,
    translation: Float64,
    intrinsics: Float64,
    segments: RaySegments,
    scale: float,
    matrix: Float64,
    gradient: Float64,
) -> float:
    """Compute the Gauss-Newton matrix (6, 6) and gradient (6,) of pose refinement.

    The objective is ``sum(weight (1 - (1 - s)^3)) / 6`` with ``s = min(1, (distance / limit)^2)``
    and limits times ``scale``. The objective and ``sum(w distance^2) / 2`` with the IRLS weights
    ``w`` have equal gradients.

    Returns:
        The objective.
    """
    matrix[:] = 0.0
    gradient[:] = 0.0
    start, end = np.empty((2, POSE)), np.empty((2, POSE))
    cost = 0.0
    for i in range(len(segments.xy)):
        foot = _nearest(i, rotation, translation, intrinsics, segments)
        limit = scale * segments.limit[i]
        ratio = (foot.du * foot.du + foot.dv * foot.dv) / (limit * limit)
        if not foot.visible or ratio >= 1.0:
            cost += segments.weight[i] / 6.0
            continue
        cost += segments.weight[i] * (1.0 - (1.0 - ratio) ** 3) / 6.0
        weight = segments.weight[i] * (1.0 - ratio) ** 2 / (limit * limit)
        _differentiate(foot.near, foot.near_q, intrinsics, start)
        _differentiate(foot.far, foot.far_q, intrinsics, end)
        length2 = foot.au * foot.au + foot.av * foot.av
        for k in range(POSE):
            u = start[0, k] + foot.share * (end[0, k] - start[0, k])
            v = start[1, k] + foot.share * (end[1, k] - start[1, k])
            if length2 > 0.0:
                along = (u * foot.au + v * foot.av) / length2
                u -= along * foot.au
                v -= along * foot.av
            start[0, k], start[1, k] = u, v
        for k in range(POSE):
            gradient[k] += weight * (start[0, k] * foot.du + start[1, k] * foot.dv)
            for m in range(k + 1):
                matrix[k, m] += weight * (start[0, k] * start[0, m] + start[1, k] * start[1, m])
    for k in range(POSE):
        for m in range(k):
            matrix[m, k] = matrix[k, m]
    return cost


@_kernel
def _measure(
    rotation: Float64,
    translation: Float64,
    intrinsics: Float64,
    segments: RaySegments,
    distances: Float64,
    depths: Float64,
) -> None:
    for i in range(len(segments.xy)):
        foot = _nearest(i, rotation, translation, intrinsics, segments)
        distances[i] = depths[i] = np.nan
        if foot.visible:
            distances[i] = np.sqrt(foot.du * foot.du + foot.dv * foot.dv)
            depths[i] = 1.0 / ((1.0 - foot.share) / foot.near[2] + foot.share / foot.far[2])


@_helper
def _nearest(
    i: int, rotation: Float64, translation: Float64, intrinsics: Float64, segments: RaySegments
) -> _NearestPoint:
    near_q = _rotated(rotation, segments.near[i, 0], segments.near[i, 1], segments.near[i, 2])
    far_q = _rotated(rotation, segments.far[i, 0], segments.far[i, 1], segments.far[i, 2])
    x, y, z = translation[0], translation[1], translation[2]
    near = near_q[0] + x, near_q[1] + y, near_q[2] + z
    far = far_q[0] + x, far_q[1] + y, far_q[2] + z
    if not (near[2] > MIN_DEPTH and far[2] > MIN_DEPTH):
        return _NearestPoint(False, near, near_q, far, far_q, 0.0, 0.0, 0.0, 0.0, 0.0)
    du = intrinsics[0] * near[0] / near[2] + intrinsics[2] - segments.xy[i, 0]
    dv = intrinsics[1] * near[1] / near[2] + intrinsics[3] - segments.xy[i, 1]
    au = intrinsics[0] * (far[0] / far[2] - near[0] / near[2])
    av = intrinsics[1] * (far[1] / far[2] - near[1] / near[2])
    length2 = au * au + av * av
    share = 0.0
    if length2 > 0.0:
        share = min(max(-(du * au + dv * av) / length2, 0.0), 1.0)
    du += share * au
    dv += share * av
    if not 0.0 < share < 1.0:
        au = av = 0.0
    return _NearestPoint(True, near, near_q, far, far_q, share, du, dv, au, av)


@_helper
def _rotated(rotation: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@_helper
def _differentiate(
    point: tuple[float, float, float],
    rotated: tuple[float, float, float],
    intrinsics: Float64,
    out: Float64,
) -> None:
    """Compute the Jacobian (2, 6) of a projected point by rotation and translation."""
    inverse = 1.0 / point[2]
    fx, fy = intrinsics[0] * inverse, intrinsics[1] * inverse
    a, b = point[0] * inverse, point[1] * inverse
    qx, qy, qz = rotated
    out[0, 0] = -fx * a * qy
    out[0, 1] = fx * (qz + a * qx)
    out[0, 2] = -fx * qy
    out[0, 3] = fx
    out[0, 4] = 0.0
    out[0, 5] = -fx * a
    out[1, 0] = -fy * (qz + b * qy)
    out[1, 1] = fy * b * qx
    out[1, 2] = fy * qx
    out[1, 3] = 0.0
    out[1, 4] = fy
    out[1, 5] = -fy * b
