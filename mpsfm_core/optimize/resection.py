"""Pose of one camera from pixels whose points lie somewhere on a segment each.

Depth bounds the point of a match along the ray of the other image, from near to far; where it is
known the two are the same. The objective is the sum of Tukey's biweight of each pixel's distance
to the projected segment: quadratic for small distances, no influence from a limit on. Its
Gauss-Newton steps move the pose as bundle adjustment does, ``R <- exp(w) R, t <- t + dt``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.optimize.bundle_kernels import MIN_DEPTH, rotation_from_vector
from mpsfm_core.support import jit

DAMPING = 1e-6
"""Relative, of the normal equations: keeps few matches from being singular (ours)."""
MAX_TURN = 1.0
"""Radians; a step that turns more comes from matches that determine no pose (ours)."""


class RaySegments(NamedTuple):
    """Pixels and the segments they may see.

    ``near``, ``far``: (m, 3) world points; ``xy`` (m, 2) pixels; ``limit`` (m,) px, distance that
    has no influence any more; ``weight`` (m,).
    """

    near: Float64
    far: Float64
    xy: Float64
    limit: Float64
    weight: Float64


class _NearestPoint(NamedTuple):
    """Where a projected segment comes nearest to its pixel.

    ``near``, ``far``: the ends in the camera, their rotated world points being ``near_q`` and
    ``far_q``; ``share`` of the way between their projections; ``du``, ``dv`` px from the pixel;
    ``au``, ``av`` the segment's direction if the foot can slide along it, else 0.
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
"""Numbers of a pose."""
_kernel, _helper = jit.kernel(), jit.helper()


def measure_segments(
    pose: Pose, intrinsics: Float64, segments: RaySegments
) -> tuple[Float64, Float64]:
    """(m,) px between pixels and projected segments, and the depth of the nearest point there.

    Both are NaN where an end is not in front of the camera. ``intrinsics``: fx, fy, cx, cy.
    """
    distances, depths = np.empty((2, len(segments.xy)))
    rotation, translation = map(np.ascontiguousarray, pose)
    _measure(rotation, translation, intrinsics, segments, distances, depths)
    return distances, depths


def refine_pose(
    pose: Pose, intrinsics: Float64, segments: RaySegments, *, scales: Float64
) -> tuple[Float64, Float64]:
    """The pose after a Gauss-Newton step for each of the ``scales`` of the limits.

    Large scales first let matches pull that are far off yet. Matches that determine no pose leave
    it where it was.
    """
    rotation, translation = map(np.ascontiguousarray, pose)
    matrix, vector = np.empty((POSE, POSE)), np.empty(POSE)
    for scale in scales:
        linearize_pose(rotation, translation, intrinsics, segments, scale, matrix, vector)
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            break
        step = -np.linalg.solve(matrix + np.diag(DAMPING * diagonal), vector)
        if not np.linalg.norm(step[:3]) < MAX_TURN:
            break
        rotation = np.array(rotation_from_vector(step[0], step[1], step[2])) @ rotation
        translation = translation + step[3:]
    return rotation, translation


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
    """Write the Gauss-Newton matrix (6, 6) and the gradient (6,) of the objective, return it.

    The objective is ``sum(weight (1 - (1 - s)^3)) / 6`` of ``s = min(1, (distance / limit)^2)``,
    with the limits times ``scale``; so its gradient is that of ``sum(w distance^2) / 2`` with
    fixed weights.
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
    """out (2, 6) <- d(u, v) / d(w, dt) of a point's projection."""
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
