"""Compiled kernels of bundle adjustment: linearization, Schur complement, back-substitution.

Each kernel processes a range of 3D points and writes only to the data of that range. Threads
process the ranges of points without the GIL, and results do not depend on the number of threads.
Kernels allocate no memory, so numba's reference counting is disabled (``_nrt=False``), which is 1.7
times faster.

Observations are sorted by point, then by image. Each image with a variable pose or depth scale has
a pose slot, the index of its 7 parameters among the variable parameters. Each variable intrinsic
parameter of a camera has an intrinsic slot, its index among the variable intrinsic parameters. A
vector of camera parameters contains 7 parameters per pose slot (rotation, translation, log scale of
the depth map), followed by one parameter per intrinsic slot. A step updates rotation, translation,
log scale and focal length by ``R <- exp(w) R``, ``t <- t + dt``, ``s <- s + ds`` and ``f <- f
exp(a)``, and adds the changes of the other intrinsic parameters.

The camera models are COLMAP's OPENCV and OPENCV_FISHEYE, ``(fx (m u + a) + cx, fy (m v + b) + cy)``
with ``u = x / z``, ``v = y / z``. OPENCV has the radial factor ``m = 1 + k1 r^2 + k2 r^4`` with
``r^2 = u^2 + v^2``, and the tangential distortion ``(a, b)`` of the coefficients ``p1`` and ``p2``.
OPENCV_FISHEYE has ``m = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r`` with ``t = atan(r)``, and
no tangential distortion. PINHOLE, SIMPLE_RADIAL and RADIAL are OPENCV with coefficients of 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.data.camera_models import NUM_INTRINSICS, IntrinsicParameter
from mpsfm_core.geometry.distortion import MIN_SLOPE
from mpsfm_core.optimize.losses import evaluate_loss
from mpsfm_core.support import jit

Int32 = NDArray[np.int32]

MIN_DEPTH = 1e-9
"""Minimum depth of a point that projects into an image. [COLMAP: machine epsilon]"""
MAX_SLOPE = 1e6
"""Maximum slope ``(|x| + |y|) / z`` of the ray of a point that projects into an image, which keeps
all derivatives finite. [ours]"""
MIN_DEPTH_RATIO = 0.1
"""Minimum ratio of a point's depths after and before a step. A step of the linearized log depth can
move distant points behind the camera. [ours]"""
STEP_REDUCTION = 0.25
"""Factor that shortens the step of a point whose depth decreases too much. [ours]"""
MIN_STEP_LENGTH = 0.01
"""Ratio of shortened to full step length of a point below which the point is not moved. [ours]"""
MAX_POINT_STEPS = 10
"""Maximum number of steps of each point with fixed cameras after a joint step of points and
cameras. Points with outliers converge slowly under robust losses, and the additional steps halve
the run time. [tuned: benchmarks.bundle_adjustment]"""
POINT_STEP_DAMPING = 1e-6
"""Levenberg-Marquardt damping of the steps of single points with fixed cameras. [ours]"""
MIN_FISHEYE_RADIUS2 = 1e-8
"""Squared radius ``u^2 + v^2`` below which the radial factor of a fisheye camera is its Taylor
polynomial of first order in ``u^2 + v^2``. [ours]"""
NUM_IMAGE_PARAMS, _COLUMN = np.int64(7), np.int64(1)
"""Number of parameters of an image (pose and log scale of its depth map), and of one column."""
LOG_SCALE_IDX = 6
"""Index of the depth map's log scale among the 7 parameters of an image."""
LOG_FOCAL = int(IntrinsicParameter.FOCAL_LENGTH)
LOG_ASPECT = int(IntrinsicParameter.ASPECT_RATIO)
CENTER_X = int(IntrinsicParameter.PRINCIPAL_POINT_X)
CENTER_Y = int(IntrinsicParameter.PRINCIPAL_POINT_Y)
DISTORTION = int(IntrinsicParameter.RADIAL_DISTORTION)
"""Indices of intrinsic parameters, as plain integers for numba. The four distortion coefficients
follow ``DISTORTION``."""
_ONLY = np.int64(0)
"""Row index for arrays of normal equations that have a single row."""


class BundleObservations(NamedTuple):
    """Observations of all points, sorted by point, then by image."""

    start: Int64
    """(p + 1,) index of the first observation of each point, and the number of observations."""
    image: Int32
    xy: Float64
    weight: Float64
    """Inverse standard deviation of the keypoint of each observation, in 1 / pixels."""
    log_depth: Float64
    depth_weight: Float64
    """Inverse standard deviation of the log depth of each observation, 0 if depth is invalid."""


class ParameterLayout(NamedTuple):
    """Indices of the variable parameters in the linear system; -1 for constants.

    An image has a pose slot (index in the linear system) if its pose or log depth scale is
    variable.
    """

    camera_of_image: Int32
    pose_slot: Int32
    intrinsic_slot: Int32
    """(k, 8) intrinsic slot (index among the variable intrinsics) of each
    :class:`~mpsfm_core.data.camera_models.IntrinsicParameter`."""
    calibrated: Bool
    """(k,) bool, True for cameras with a variable intrinsic parameter."""
    distorted: Bool
    """(k,) bool, True for cameras with distortion, or with a variable distortion coefficient."""
    fisheye: Bool
    """(k,) bool, True for OPENCV_FISHEYE and False for OPENCV cameras."""
    variable_point: Bool
    variable_scale: Bool
    num_poses: int
    """Number of pose slots."""
    first_block: Int64
    """(s + 1,) number of the first 7 x 7 block of each row of the reduced camera system, which is
    the diagonal block, and the total number of blocks on and above the diagonal."""
    block_column: Int32
    """(b,) column of each block, as a pose slot, ascending in each row."""


class RobustLosses(NamedTuple):
    """Types and scales of the robust losses of reprojection and log-depth residuals."""

    reprojection_loss: int
    reprojection_scale: float
    depth_loss: int
    depth_scale: float


class BundleData(NamedTuple):
    """Observations, parameter layout and losses, which are constant during bundle adjustment."""

    obs: BundleObservations
    layout: ParameterLayout
    robust: RobustLosses


class BundleParameters(NamedTuple):
    """Values of the poses, depth scales, intrinsics and points in bundle adjustment."""

    rotations: Float64
    """(n, 3, 3) rotations of ``cam_from_world``."""
    translations: Float64
    """(n, 3) translations of ``cam_from_world``."""
    log_scales: Float64
    """(n,) log of the scale factor on the depth map of each image."""
    intrinsics: Float64
    """(k, 4) camera parameters fx, fy, cx, cy in pixels."""
    distortion: Float64
    """(k, 4) distortion coefficients k1, k2, p1, p2, or k1, k2, k3, k4 of a fisheye camera."""
    points: Float64
    """(p, 3) points in the world frame."""


class ReducedCameraSystem(NamedTuple):
    """Reduced camera system (Schur complement) of a range of points or of all points."""

    blocks: Float64
    """(pairs, 7, 7) blocks of the Schur complement for pairs of images with common points. Blocks
    on the diagonal store only their upper triangle."""
    border: Float64
    """(intrinsics, 7 poses) block between intrinsic and image parameters."""
    corner: Float64
    """(intrinsics, intrinsics) block of the Schur complement for the intrinsic parameters."""
    gradient: Float64
    """(d,) gradient of the cost by the camera parameters, before the elimination of points."""
    diagonal: Float64
    """(d,) diagonal of the Gauss-Newton matrix before the elimination of points."""
    rhs: Float64
    """(d,) change of the camera parameters' gradient by the elimination of points."""


class EliminationBuffers(NamedTuple):
    """Buffers for one range of points, whose tracks have up to ``longest`` observations."""

    slots: Int64
    """(longest,) pose slots of the images that observe the current point."""
    intrinsics: Int64
    """(8 longest,) intrinsic slots of the cameras that observe the current point."""
    y: Float64
    """(longest, 3, 7) blocks of the normal equations between the point and image parameters."""
    yf: Float64
    """(8 longest, 3, 1) blocks of the normal equations between the point and intrinsics."""
    columns: Float64
    effects: Float64
    """(8, 3) effects of the intrinsic parameters on the current observation. An intrinsic parameter
    with the effect ``(m, a, b)`` displaces the camera-frame point by ``(m x + a, m y + b, 0)``."""
    before: Float64
    """(longest, 2) cost and point depth of each observation before a step."""
    block: Float64
    """(1, 10) normal equations of one point: 6 entries of the block, gradient, mean of the
    diagonal."""
    vector: Float64


class LinearizedObservation(NamedTuple):
    """Cost, gradient and Gauss-Newton matrix of one observation in the camera frame.

    The point in the camera frame is ``(x, y, z) = q + t`` with the rotated point ``q = R X``. The
    vector ``g`` is the gradient of the cost by the camera-frame point, and ``h`` is the
    Gauss-Newton matrix, whose entry ``hxy`` is 0 without distortion. Steps of pose and 3D point
    displace the camera-frame point by ``w x q + dt`` and ``R dX``. The fields ``gs``, ``hss`` and
    ``hzs`` are the derivatives by the log scale of the depth map.
    """

    visible: bool
    cost: float
    qx: float
    qy: float
    qz: float
    x: float
    y: float
    z: float
    gx: float
    gy: float
    gz: float
    hxx: float
    hyy: float
    hxz: float
    hyz: float
    hzz: float
    gs: float
    hss: float
    hzs: float
    hxy: float


def allocate_buffers(longest: int) -> EliminationBuffers:
    """Allocate the buffers of one range of points with up to ``longest`` observations each."""
    longest = max(longest, 1)
    return EliminationBuffers(
        slots=np.empty(longest, np.int64),
        intrinsics=np.empty(NUM_INTRINSICS * longest, np.int64),
        y=np.empty((longest, 3, NUM_IMAGE_PARAMS)),
        yf=np.empty((NUM_INTRINSICS * longest, 3, 1)),
        columns=np.empty((3, NUM_IMAGE_PARAMS)),
        effects=np.empty((NUM_INTRINSICS, 3)),
        before=np.empty((longest, 2)),
        block=np.empty((1, 10)),
        vector=np.empty(3),
    )


_OPTIONS: dict[str, Any] = {"fastmath": {"contract"}, "forceinline": True, "_nrt": False}
_kernel, _helper = jit.kernel(**_OPTIONS), jit.helper(**_OPTIONS)


@_kernel
def counting_sort(keys: Int32, previous: Int64, start: Int64, order: Int64) -> None:
    """Sort row indices by integer keys with a stable counting sort.

    Args:
        keys: Integer sort key of each row.
        previous: Row indices in their order before sorting.
        start: (number of keys + 2,) zeros, which receive the first sorted position of each key.
        order: Array that receives the sorted row indices.
    """
    for row in previous:
        start[keys[row] + 2] += 1
    for key in range(2, len(start)):
        start[key] += start[key - 1]
    for row in previous:
        order[start[keys[row] + 1]] = row
        start[keys[row] + 1] += 1


@_kernel
def find_covisible_poses(
    slots: Int32, ends: Int64, order: Int64, start: Int64, last: Int64, first: Int64, columns: Int32
) -> None:
    """Find the blocks of the reduced camera system, one per image pair with a shared point.

    Args:
        slots: (m,) pose slot (index in the linear system) of each observation, or -1. The
            observations are sorted by point.
        ends: (m,) end of the observations of the same point.
        order: Observations with a pose slot, sorted by pose slot.
        start: (s + 1,) first observation of each pose slot in ``order``.
        last: (s,) array of -1, which receives the last row with a block in each column.
        first: (s + 1,) receives :attr:`ParameterLayout.first_block`.
        columns: (b,) receives :attr:`ParameterLayout.block_column`, unless it is empty.
    """
    fills, count = len(columns) > 0, np.int64(0)
    for row in range(len(last)):
        first[row], last[row] = count, row
        if fills:
            columns[count] = row
        count += 1
        for n in range(start[row], start[row + 1]):
            for k in range(order[n] + 1, ends[order[n]]):
                column = slots[k]
                if column >= 0 and last[column] != row:
                    last[column] = row
                    place = count
                    while fills and columns[place - 1] > column:  # insertion sort
                        columns[place] = columns[place - 1]
                        place -= 1
                    if fills:
                        columns[place] = column
                    count += 1
    first[len(last)] = count


class DistortedRay(NamedTuple):
    """Distorted ray ``(factor u + shift_u, factor v + shift_v)`` with its derivatives.

    The Jacobian by ``(u, v)`` is symmetric. Its rows are ``(factor + 2 growth u^2 + tuu, 2 growth u
    v + tuv)`` and ``(2 growth u v + tuv, factor + 2 growth v^2 + tvv)``. The derivative of the
    distorted radius without tangential distortion is ``slope``.
    """

    valid: bool
    factor: float
    growth: float
    slope: float
    shift_u: float
    shift_v: float
    tuu: float
    tuv: float
    tvv: float


@_helper
def _distort_fisheye(r2: float, k1: float, k2: float, k3: float, k4: float) -> DistortedRay:
    """Evaluate OPENCV_FISHEYE at a ray with squared radius ``r2``."""
    n = 0.0
    if r2 < MIN_FISHEYE_RADIUS2:
        growth = k1 - 1.0 / 3.0
        return DistortedRay(True, 1.0 + growth * r2, growth, 1.0 + 3.0 * growth * r2, n, n, n, n, n)
    r = np.sqrt(r2)
    t = np.arctan(r)
    t2 = t * t
    factor = t * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
    by_angle = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * (9.0 * k4))))
    slope = by_angle / (1.0 + r2)
    growth = 0.5 * (slope - factor) / r2
    valid = factor * r > MIN_SLOPE * t and by_angle > MIN_SLOPE
    return DistortedRay(valid, factor, growth, slope, n, n, n, n, n)


@_helper
def distort_ray(
    u: float, v: float, coefficients: Float64, camera: int, fisheye: bool
) -> DistortedRay:
    """Distort the ray ``(u, v, 1)`` by four coefficients of OPENCV or OPENCV_FISHEYE.

    Args:
        u: First normalized coordinate ``x / z``.
        v: Second normalized coordinate ``y / z``.
        coefficients: (k, 4) coefficients k1, k2, p1, p2, or k1, k2, k3, k4 of a fisheye camera.
        camera: Row of the camera in ``coefficients``.
        fisheye: Use OPENCV_FISHEYE.

    Returns:
        The distorted ray, invalid where the distortion folds the image over.
    """
    r2 = u * u + v * v
    k1, k2 = coefficients[camera, 0], coefficients[camera, 1]
    p1, p2 = coefficients[camera, 2], coefficients[camera, 3]
    if fisheye:
        return _distort_fisheye(r2, k1, k2, p1, p2)
    factor = 1.0 + (k1 + k2 * r2) * r2
    growth = k1 + 2.0 * k2 * r2
    slope = 1.0 + (3.0 * k1 + 5.0 * k2 * r2) * r2
    shift_u = 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    shift_v = 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
    tuu = 2.0 * p1 * v + 6.0 * p2 * u
    tuv = 2.0 * p1 * u + 2.0 * p2 * v
    tvv = 6.0 * p1 * v + 2.0 * p2 * u
    a, b = factor + 2.0 * growth * u * u + tuu, factor + 2.0 * growth * v * v + tvv
    mixed = 2.0 * growth * u * v + tuv
    valid = factor > MIN_SLOPE and slope > MIN_SLOPE
    valid = valid and a > 0.0 and a * b - mixed * mixed > 0.5 * MIN_SLOPE * MIN_SLOPE
    return DistortedRay(valid, factor, growth, slope, shift_u, shift_v, tuu, tuv, tvv)


@_helper
def _radial_derivative(n: int, r2: float, fisheye: bool) -> float:
    """Return the derivative of the radial factor by the radial coefficient ``k1 .. k4``."""
    if not fisheye:
        return r2 if n == 0 else r2 * r2
    r = np.sqrt(r2)
    t = np.arctan(r)
    value: float = t * t if r2 < MIN_FISHEYE_RADIUS2 else t * t * t / r
    for _ in range(n):
        value *= t * t
    return value


@_helper
def _fill_effects(
    s: LinearizedObservation,
    camera: int,
    layout: ParameterLayout,
    state: BundleParameters,
    effects: Float64,
) -> None:
    """Write the effects of the variable intrinsic parameters on an observation.

    An intrinsic parameter that changes the distorted ray by ``w`` has the effect of a displacement
    ``z A^-1 w`` of the camera-frame point, with the Jacobian ``A`` of the distortion. With ``w = m
    (u, v) + t`` and the Jacobian ``T`` of the tangential distortion, the displacement is ``(m /
    slope) (x, y) + A^-1 (z t - (m / slope) T (x, y))``, because ``(u, v)`` is an eigenvector of ``A
    - T``.
    """
    fisheye = layout.fisheye[camera]
    inverse = 1.0 / s.z
    u, v = s.x * inverse, s.y * inverse
    d = distort_ray(u, v, state.distortion, camera, fisheye)
    r2 = u * u + v * v
    a, b = d.factor + 2.0 * d.growth * u * u + d.tuu, d.factor + 2.0 * d.growth * v * v + d.tvv
    mixed = 2.0 * d.growth * u * v + d.tuv
    scale = 1.0 / (a * b - mixed * mixed)
    for n in range(NUM_INTRINSICS):
        if layout.intrinsic_slot[camera, n] < 0:
            continue
        m = tu = tv = 0.0
        if n == LOG_FOCAL:
            m, tu, tv = d.factor, d.shift_u, d.shift_v
        elif n == LOG_ASPECT:
            tv = d.factor * v + d.shift_v
        elif n == CENTER_X:
            tu = 1.0 / state.intrinsics[camera, 0]
        elif n == CENTER_Y:
            tv = 1.0 / state.intrinsics[camera, 1]
        elif n < DISTORTION + 2 or fisheye:
            m = _radial_derivative(n - DISTORTION, r2, fisheye)
        elif n == DISTORTION + 2:
            tu, tv = 2.0 * u * v, r2 + 2.0 * v * v
        else:
            tu, tv = r2 + 2.0 * u * u, 2.0 * u * v
        by = m / d.slope
        tu = s.z * tu - by * (d.tuu * s.x + d.tuv * s.y)
        tv = s.z * tv - by * (d.tuv * s.x + d.tvv * s.y)
        effects[n, 0] = by
        effects[n, 1] = (b * tu - mixed * tv) * scale
        effects[n, 2] = (a * tv - mixed * tu) * scale


@_helper
def _add_depth_residual(
    k: int,
    image: int,
    z: float,
    inverse: float,
    rho: float,
    gz: float,
    hzz: float,
    bundle: BundleData,
    state: BundleParameters,
) -> tuple[float, float, float, float, float, float]:
    """Add the log-depth residual of an observation at depth ``z`` to its derivatives.

    Returns:
        Twice the cost of the observation, the fields ``gz`` and ``hzz`` with the log-depth residual
        added, and the fields ``gs``, ``hss`` and ``hzs``, which are 0 if the depth scale is
        constant or the depth is invalid.
    """
    obs, robust = bundle.obs, bundle.robust
    gs = hss = hzs = 0.0
    if obs.depth_weight[k] > 0.0:
        slope_s = obs.depth_weight[k]
        rd = (np.log(z) - obs.log_depth[k] - state.log_scales[image]) * slope_s
        depth_rho, weight = evaluate_loss(robust.depth_loss, rd * rd, robust.depth_scale)
        slope = slope_s * inverse
        rho += depth_rho
        gz += weight * slope * rd
        hzz += weight * slope * slope
        if bundle.layout.variable_scale[image]:
            gs = -weight * slope_s * rd
            hss = weight * slope_s * slope_s
            hzs = -weight * slope * slope_s
    return rho, gz, hzz, gs, hss, hzs


@_helper
def _linearize_distorted_observation(
    k: int,
    image: int,
    camera: int,
    qx: float,
    qy: float,
    qz: float,
    x: float,
    y: float,
    z: float,
    bundle: BundleData,
    state: BundleParameters,
) -> LinearizedObservation:
    """Linearize an observation in front of a camera with lens distortion."""
    obs, robust = bundle.obs, bundle.robust
    n = 0.0
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    d = distort_ray(u, v, state.distortion, camera, bundle.layout.fisheye[camera])
    if not d.valid:
        return LinearizedObservation(
            False, n, qx, qy, qz, x, y, z, n, n, n, n, n, n, n, n, n, n, n, n
        )
    fx = state.intrinsics[camera, 0] * obs.weight[k]
    fy = state.intrinsics[camera, 1] * obs.weight[k]
    ru = fx * u * d.factor + (state.intrinsics[camera, 2] - obs.xy[k, 0]) * obs.weight[k]
    rv = fy * v * d.factor + (state.intrinsics[camera, 3] - obs.xy[k, 1]) * obs.weight[k]
    ru, rv = ru + fx * d.shift_u, rv + fy * d.shift_v
    rho, weight = evaluate_loss(
        robust.reprojection_loss, ru * ru + rv * rv, robust.reprojection_scale
    )
    # Rows of the Jacobian d(ru, rv) / d(x, y), whose product with -(u, v) is the derivative by z.
    ux = fx * inverse * (d.factor + 2.0 * d.growth * u * u + d.tuu)
    uy = fx * inverse * 2.0 * d.growth * u * v + fx * inverse * d.tuv
    vx = fy * inverse * 2.0 * d.growth * u * v + fy * inverse * d.tuv
    vy = fy * inverse * (d.factor + 2.0 * d.growth * v * v + d.tvv)
    gx, gy = weight * (ux * ru + vx * rv), weight * (uy * ru + vy * rv)
    gz = -gx * u - gy * v
    hxx, hyy = weight * (ux * ux + vx * vx), weight * (uy * uy + vy * vy)
    hxy = weight * (ux * uy + vx * vy)
    hxz, hyz = -hxx * u - hxy * v, -hxy * u - hyy * v
    hzz = -hxz * u - hyz * v
    rho, gz, hzz, gs, hss, hzs = _add_depth_residual(
        k, image, z, inverse, rho, gz, hzz, bundle, state
    )
    return LinearizedObservation(
        True, 0.5 * rho, qx, qy, qz, x, y, z, gx, gy, gz, hxx, hyy, hxz, hyz, hzz, gs, hss, hzs,
        hxy,
    )  # fmt: skip


@_helper
def linearize_observation(
    k: int, p: int, bundle: BundleData, state: BundleParameters
) -> LinearizedObservation:
    """Linearize one observation; cost and derivatives are 0 if the point is not visible."""
    obs, robust = bundle.obs, bundle.robust
    image = obs.image[k]
    rotation, points = state.rotations, state.points
    px, py, pz = points[p, 0], points[p, 1], points[p, 2]
    qx = rotation[image, 0, 0] * px + rotation[image, 0, 1] * py + rotation[image, 0, 2] * pz
    qy = rotation[image, 1, 0] * px + rotation[image, 1, 1] * py + rotation[image, 1, 2] * pz
    qz = rotation[image, 2, 0] * px + rotation[image, 2, 1] * py + rotation[image, 2, 2] * pz
    x = qx + state.translations[image, 0]
    y = qy + state.translations[image, 1]
    z = qz + state.translations[image, 2]
    n = 0.0
    if not (z > MIN_DEPTH and z * MAX_SLOPE > abs(x) + abs(y)):
        return LinearizedObservation(
            False, n, qx, qy, qz, x, y, z, n, n, n, n, n, n, n, n, n, n, n, n
        )
    camera = bundle.layout.camera_of_image[image]
    if bundle.layout.distorted[camera]:
        return _linearize_distorted_observation(
            k, image, camera, qx, qy, qz, x, y, z, bundle, state
        )
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    fx = state.intrinsics[camera, 0] * obs.weight[k]
    fy = state.intrinsics[camera, 1] * obs.weight[k]
    ru = fx * u + (state.intrinsics[camera, 2] - obs.xy[k, 0]) * obs.weight[k]
    rv = fy * v + (state.intrinsics[camera, 3] - obs.xy[k, 1]) * obs.weight[k]
    rho, weight = evaluate_loss(
        robust.reprojection_loss, ru * ru + rv * rv, robust.reprojection_scale
    )
    fx *= inverse
    fy *= inverse
    gx, gy = weight * fx * ru, weight * fy * rv
    gz = -gx * u - gy * v
    hxx, hyy = weight * fx * fx, weight * fy * fy
    hzz = hxx * u * u + hyy * v * v
    hxz, hyz = -hxx * u, -hyy * v
    rho, gz, hzz, gs, hss, hzs = _add_depth_residual(
        k, image, z, inverse, rho, gz, hzz, bundle, state
    )
    return LinearizedObservation(
        True, 0.5 * rho, qx, qy, qz, x, y, z, gx, gy, gz, hxx, hyy, hxz, hyz, hzz, gs, hss, hzs,
        n,
    )  # fmt: skip


@_helper
def _fill_pose_columns(s: LinearizedObservation, columns: Float64) -> None:
    """Multiply an observation's Gauss-Newton matrix by the Jacobian of image parameters."""
    columns[0, 0] = s.hxz * s.qy
    columns[0, 1] = s.hxx * s.qz - s.hxz * s.qx
    columns[0, 2] = -s.hxx * s.qy
    columns[1, 0] = s.hyz * s.qy - s.hyy * s.qz
    columns[1, 1] = -s.hyz * s.qx
    columns[1, 2] = s.hyy * s.qx
    columns[2, 0] = s.hzz * s.qy - s.hyz * s.qz
    columns[2, 1] = s.hxz * s.qz - s.hzz * s.qx
    columns[2, 2] = s.hyz * s.qx - s.hxz * s.qy
    columns[0, 3] = s.hxx
    columns[1, 3] = columns[0, 4] = 0.0
    columns[1, 4] = s.hyy
    columns[2, 3] = columns[0, 5] = s.hxz
    columns[2, 4] = columns[1, 5] = s.hyz
    columns[2, 5] = s.hzz
    columns[0, 6] = columns[1, 6] = 0.0
    columns[2, 6] = s.hzs
    if s.hxy != 0.0:
        columns[0, 0] -= s.hxy * s.qz
        columns[1, 1] += s.hxy * s.qz
        columns[0, 2] += s.hxy * s.qx
        columns[1, 2] -= s.hxy * s.qy
        columns[1, 3] = columns[0, 4] = s.hxy


@_helper
def _add_pose(
    s: LinearizedObservation, columns: Float64, slot: int, row: int, system: ReducedCameraSystem
) -> None:
    """Add the gradient and diagonal block of an observation's pose to the camera system."""
    blocks, gradient, diagonal = system.blocks, system.gradient, system.diagonal
    n = NUM_IMAGE_PARAMS * slot
    gradient[n] += s.qy * s.gz - s.qz * s.gy
    gradient[n + 1] += s.qz * s.gx - s.qx * s.gz
    gradient[n + 2] += s.qx * s.gy - s.qy * s.gx
    gradient[n + 3] += s.gx
    gradient[n + 4] += s.gy
    gradient[n + 5] += s.gz
    gradient[n + 6] += s.gs
    diagonal[n] += s.qy * columns[2, 0] - s.qz * columns[1, 0]
    diagonal[n + 1] += s.qz * columns[0, 1] - s.qx * columns[2, 1]
    diagonal[n + 2] += s.qx * columns[1, 2] - s.qy * columns[0, 2]
    diagonal[n + 3] += s.hxx
    diagonal[n + 4] += s.hyy
    diagonal[n + 5] += s.hzz
    diagonal[n + 6] += s.hss
    for b in range(NUM_IMAGE_PARAMS):
        c0, c1, c2 = columns[0, b], columns[1, b], columns[2, b]
        blocks[row, 0, b] += s.qy * c2 - s.qz * c1
        if b >= 1:
            blocks[row, 1, b] += s.qz * c0 - s.qx * c2
        if b >= 2:
            blocks[row, 2, b] += s.qx * c1 - s.qy * c0
    blocks[row, 3, 3] += s.hxx
    blocks[row, 3, 4] += s.hxy
    blocks[row, 3, 5] += s.hxz
    blocks[row, 4, 4] += s.hyy
    blocks[row, 4, 5] += s.hyz
    blocks[row, 5, 5] += s.hzz
    blocks[row, 5, 6] += s.hzs
    blocks[row, 6, 6] += s.hss


@_helper
def _add_intrinsic(
    s: LinearizedObservation,
    x: float,
    y: float,
    columns: Float64,
    intrinsic: int,
    slot: int,
    poses: int,
    system: ReducedCameraSystem,
) -> None:
    """Add the gradient and blocks of an intrinsic parameter to the camera system.

    A change of the intrinsic parameter by 1 has the effect of moving the camera-frame point by
    ``(x, y, 0)``.
    """
    own = x * x * s.hxx + y * y * s.hyy
    if s.hxy != 0.0:
        own += 2.0 * x * y * s.hxy
    system.gradient[NUM_IMAGE_PARAMS * poses + intrinsic] += x * s.gx + y * s.gy
    system.diagonal[NUM_IMAGE_PARAMS * poses + intrinsic] += own
    system.corner[intrinsic, intrinsic] += own
    if slot >= 0:
        for a in range(NUM_IMAGE_PARAMS):
            system.border[intrinsic, NUM_IMAGE_PARAMS * slot + a] += (
                x * columns[0, a] + y * columns[1, a]
            )


@_helper
def _add_intrinsic_pair(
    s: LinearizedObservation,
    first: int,
    second: int,
    slots: Int32,
    camera: int,
    effects: Float64,
    system: ReducedCameraSystem,
) -> None:
    """Add the block between two variable intrinsic parameters of a camera."""
    m, a, b = effects[first, 0], effects[first, 1], effects[first, 2]
    n, c, d = effects[second, 0], effects[second, 1], effects[second, 2]
    both = s.x * s.x * s.hxx + s.y * s.y * s.hyy + 2.0 * s.x * s.y * s.hxy
    both *= m * n
    hx, hy = s.hxx * s.x + s.hxy * s.y, s.hxy * s.x + s.hyy * s.y
    both += m * (hx * c + hy * d) + n * (hx * a + hy * b)
    both += a * (s.hxx * c + s.hxy * d) + b * (s.hxy * c + s.hyy * d)
    row, column = slots[camera, first], slots[camera, second]
    system.corner[row, column] += both
    system.corner[column, row] += both


@_helper
def _fill_intrinsic_column(s: LinearizedObservation, x: float, y: float, columns: Float64) -> None:
    """Multiply an observation's Gauss-Newton matrix by the Jacobian of the intrinsic parameter."""
    columns[0, 0] = x * s.hxx + y * s.hxy
    columns[1, 0] = y * s.hyy + x * s.hxy
    columns[2, 0] = x * s.hxz + y * s.hyz


@_helper
def _add_intrinsics(
    s: LinearizedObservation,
    camera: int,
    slot: int,
    bundle: BundleData,
    state: BundleParameters,
    columns: Float64,
    effects: Float64,
    system: ReducedCameraSystem,
) -> None:
    """Add the variable intrinsic parameters of an observation to the camera system."""
    layout = bundle.layout
    poses = layout.num_poses
    _fill_effects(s, camera, layout, state, effects)
    for n in range(NUM_INTRINSICS):
        intrinsic = layout.intrinsic_slot[camera, n]
        if intrinsic >= 0:
            x = effects[n, 0] * s.x + effects[n, 1]
            y = effects[n, 0] * s.y + effects[n, 2]
            _add_intrinsic(s, x, y, columns, intrinsic, slot, poses, system)
            for before in range(n):
                if layout.intrinsic_slot[camera, before] >= 0:
                    _add_intrinsic_pair(
                        s, before, n, layout.intrinsic_slot, camera, effects, system
                    )


@_helper
def _add_point(
    s: LinearizedObservation, rotation: Float64, image: int, block: Float64, p: int
) -> None:
    """Add the Gauss-Newton matrix and gradient of an observation to those of its point."""
    r = rotation
    for a in range(3):
        r0, r1, r2 = r[image, 0, a], r[image, 1, a], r[image, 2, a]
        block[p, 6 + a] += r0 * s.gx + r1 * s.gy + r2 * s.gz
        c0 = r0 * s.hxx + r2 * s.hxz
        c1 = r1 * s.hyy + r2 * s.hyz
        if s.hxy != 0.0:
            c0 += r1 * s.hxy
            c1 += r0 * s.hxy
        c2 = r0 * s.hxz + r1 * s.hyz + r2 * s.hzz
        for b in range(a + 1):
            block[p, a * (a + 1) // 2 + b] += (
                c0 * r[image, 0, b] + c1 * r[image, 1, b] + c2 * r[image, 2, b]
            )


@_helper
def _add_coupling(
    columns: Float64, width: int, rotation: Float64, image: int, y: Float64, n: int, fresh: bool
) -> None:
    """Write (if ``fresh``) or add an observation's block between point and camera parameters."""
    for c in range(3):
        r0, r1, r2 = rotation[image, 0, c], rotation[image, 1, c], rotation[image, 2, c]
        for a in range(width):
            value = r0 * columns[0, a] + r1 * columns[1, a] + r2 * columns[2, a]
            y[n, c, a] = value if fresh else y[n, c, a] + value


@_helper
def _invert_factor(block: Float64, p: int, damping: float) -> bool:
    """Invert the Cholesky factor ``L`` of a point's damped block ``V + damping m I = L L^T``.

    The damping of a point is relative to ``m``, the mean of the diagonal of V. The inverse factor
    replaces V in ``block[p, :6]``, and ``m`` is written to ``block[p, 9]``. A point in a single
    view has no constraint along its ray. Isotropic damping prevents motion of the point along its
    ray, unlike damping by the diagonal of V.

    Returns:
        False if the damped block is not positive definite, in which case V is unchanged.
    """
    block[p, 9] = (block[p, 0] + block[p, 2] + block[p, 5]) / 3.0
    boost = damping * block[p, 9]
    a = block[p, 0] + boost
    if not (a > 0.0 and a < np.inf):
        return False
    i00 = 1.0 / np.sqrt(a)
    l10, l20 = block[p, 1] * i00, block[p, 3] * i00
    b = block[p, 2] + boost - l10 * l10
    if not (b > 0.0 and b < np.inf):
        return False
    i11 = 1.0 / np.sqrt(b)
    l21 = (block[p, 4] - l20 * l10) * i11
    c = block[p, 5] + boost - l20 * l20 - l21 * l21
    if not (c > 0.0 and c < np.inf):
        return False
    i22 = 1.0 / np.sqrt(c)
    i10 = -l10 * i00 * i11
    block[p, 0], block[p, 1], block[p, 2] = i00, i10, i11
    block[p, 3] = -(l20 * i00 + l21 * i10) * i22
    block[p, 4], block[p, 5] = -l21 * i11 * i22, i22
    return True


@_helper
def _whiten(block: Float64, p: int, y: Float64, n: int, width: int) -> None:
    """Multiply a (3, width) block of the normal equations by ``L^-1`` of its point."""
    i00, i10, i11 = block[p, 0], block[p, 1], block[p, 2]
    i20, i21, i22 = block[p, 3], block[p, 4], block[p, 5]
    for a in range(width):
        y0, y1, y2 = y[n, 0, a], y[n, 1, a], y[n, 2, a]
        y[n, 0, a] = i00 * y0
        y[n, 1, a] = i10 * y0 + i11 * y1
        y[n, 2, a] = i20 * y0 + i21 * y1 + i22 * y2


@_helper
def _point_step(block: Float64, p: int, g0: float, g1: float, g2: float, step: Float64) -> float:
    """Compute the step ``-V^-1 g`` of a point, and return the predicted decrease of the cost."""
    i00, i10, i11 = block[p, 0], block[p, 1], block[p, 2]
    i20, i21, i22 = block[p, 3], block[p, 4], block[p, 5]
    z0 = i00 * g0
    z1 = i10 * g0 + i11 * g1
    z2 = i20 * g0 + i21 * g1 + i22 * g2
    step[0] = -(i00 * z0 + i10 * z1 + i20 * z2)
    step[1] = -(i11 * z1 + i21 * z2)
    step[2] = -i22 * z2
    predicted: float = 0.5 * (z0 * z0 + z1 * z1 + z2 * z2)
    return predicted


@_helper
def _find_block(slot: int, first: int, last: int, layout: ParameterLayout) -> int:
    """Find the block of the pose ``slot`` among the sorted blocks ``first`` to ``last``.

    Binary search that starts at ``last``: if consecutive poses share points, the columns ascend by
    1, and ``last`` is the block.
    """
    while layout.block_column[last] != slot:
        middle = (first + last) // 2
        if layout.block_column[middle] < slot:
            first = middle + 1
        else:
            last = middle
    return last


@_helper
def _eliminate_from_poses(
    count: int,
    z0: float,
    z1: float,
    z2: float,
    layout: ParameterLayout,
    system: ReducedCameraSystem,
    scratch: EliminationBuffers,
) -> None:
    """Subtract a point's Schur complement ``Y_i^T Y_j`` from the blocks of its images."""
    blocks, rhs, slots, y = system.blocks, system.rhs, scratch.slots, scratch.y
    for a in range(count):
        own = layout.first_block[slots[a]]
        for i in range(NUM_IMAGE_PARAMS):
            y0, y1, y2 = y[a, 0, i], y[a, 1, i], y[a, 2, i]
            rhs[NUM_IMAGE_PARAMS * slots[a] + i] -= y0 * z0 + y1 * z1 + y2 * z2
            for j in range(i, NUM_IMAGE_PARAMS):
                blocks[own, i, j] -= y0 * y[a, 0, j] + y1 * y[a, 1, j] + y2 * y[a, 2, j]
        row, end = own, layout.first_block[slots[a] + 1]
        for b in range(a + 1, count):
            row = _find_block(
                slots[b], row + 1, min(row + slots[b] - slots[b - 1], end - 1), layout
            )
            for i in range(NUM_IMAGE_PARAMS):
                y0, y1, y2 = y[a, 0, i], y[a, 1, i], y[a, 2, i]
                for j in range(NUM_IMAGE_PARAMS):
                    blocks[row, i, j] -= y0 * y[b, 0, j] + y1 * y[b, 1, j] + y2 * y[b, 2, j]


@_helper
def _eliminate_from_intrinsics(
    count: int,
    num_intrinsics: int,
    z0: float,
    z1: float,
    z2: float,
    poses: int,
    system: ReducedCameraSystem,
    scratch: EliminationBuffers,
) -> None:
    """Subtract a point's Schur complement from the blocks of its cameras' intrinsic parameters."""
    intrinsics, yf, slots, y = scratch.intrinsics, scratch.yf, scratch.slots, scratch.y
    for f in range(num_intrinsics):
        y0, y1, y2 = yf[f, 0, 0], yf[f, 1, 0], yf[f, 2, 0]
        system.rhs[NUM_IMAGE_PARAMS * poses + intrinsics[f]] -= y0 * z0 + y1 * z1 + y2 * z2
        for a in range(count):
            for i in range(NUM_IMAGE_PARAMS):
                system.border[intrinsics[f], NUM_IMAGE_PARAMS * slots[a] + i] -= (
                    y0 * y[a, 0, i] + y1 * y[a, 1, i] + y2 * y[a, 2, i]
                )
        for g in range(num_intrinsics):
            system.corner[intrinsics[f], intrinsics[g]] -= (
                y0 * yf[g, 0, 0] + y1 * yf[g, 1, 0] + y2 * yf[g, 2, 0]
            )


@_helper
def _find_or_add(values: Int64, count: int, value: int) -> int:
    for index in range(count):
        if values[index] == value:
            return index
    values[count] = value
    return count


@_kernel
def eliminate_points(
    first: int,
    last: int,
    damping: float,
    bundle: BundleData,
    state: BundleParameters,
    system: ReducedCameraSystem,
    eliminated: Float64,
    scratch: EliminationBuffers,
) -> float:
    """Linearize the observations of the points ``first:last`` and eliminate these points.

    Args:
        first: Index of the first point of the range.
        last: Index after the last point of the range.
        damping: Levenberg-Marquardt damping of the points; the camera blocks remain undamped.
        bundle: Observations, parameter layout and robust losses.
        state: Poses, points, intrinsics and depth scales.
        system: Reduced camera system to which the points of the range are added.
        eliminated: (p, 10) output with a row per point: 6 entries of ``L^-1`` with the damped block
            ``V = L L^T``, the gradient, and the mean of the diagonal of V. Output rows of constant
            or unobserved points are 0.
        scratch: Buffers of the range of points.

    Returns:
        Cost of the observations of the points ``first:last``.
    """
    obs, layout = bundle.obs, bundle.layout
    slots, intrinsics, columns = scratch.slots, scratch.intrinsics, scratch.columns
    effects = scratch.effects
    poses = layout.num_poses
    cost = 0.0
    for p in range(first, last):
        count = num_intrinsics = np.int64(0)
        for a in range(10):
            eliminated[p, a] = 0.0
        for k in range(obs.start[p], obs.start[p + 1]):
            s = linearize_observation(k, p, bundle, state)
            if not s.visible:
                continue
            cost += s.cost
            image = obs.image[k]
            slot = layout.pose_slot[image]
            camera = layout.camera_of_image[image]
            _fill_pose_columns(s, columns)
            if slot >= 0:
                _add_pose(s, columns, slot, layout.first_block[slot], system)
            if layout.calibrated[camera]:
                _add_intrinsics(s, camera, slot, bundle, state, columns, effects, system)
            if not layout.variable_point[p]:
                continue
            _add_point(s, state.rotations, image, eliminated, p)
            if slot >= 0:
                # A track may contain an image twice. Observations are sorted by image, so equal
                # pose slots are adjacent.
                fresh = count == 0 or slots[count - 1] != slot
                if fresh:
                    slots[count] = slot
                    count += 1
                _add_coupling(
                    columns, NUM_IMAGE_PARAMS, state.rotations, image, scratch.y, count - 1, fresh
                )
            for parameter in range(NUM_INTRINSICS if layout.calibrated[camera] else 0):
                intrinsic = layout.intrinsic_slot[camera, parameter]
                if intrinsic >= 0:
                    n = _find_or_add(intrinsics, num_intrinsics, intrinsic)
                    x = effects[parameter, 0] * s.x + effects[parameter, 1]
                    y = effects[parameter, 0] * s.y + effects[parameter, 2]
                    _fill_intrinsic_column(s, x, y, columns)
                    fresh = n == num_intrinsics
                    _add_coupling(columns, _COLUMN, state.rotations, image, scratch.yf, n, fresh)
                    num_intrinsics = max(num_intrinsics, n + 1)
        if not _invert_factor(eliminated, p, damping):
            for a in range(10):
                eliminated[p, a] = 0.0
            continue
        g0, g1, g2 = eliminated[p, 6], eliminated[p, 7], eliminated[p, 8]
        z0 = eliminated[p, 0] * g0
        z1 = eliminated[p, 1] * g0 + eliminated[p, 2] * g1
        z2 = eliminated[p, 3] * g0 + eliminated[p, 4] * g1 + eliminated[p, 5] * g2
        for a in range(count):
            _whiten(eliminated, p, scratch.y, a, NUM_IMAGE_PARAMS)
        for f in range(num_intrinsics):
            _whiten(eliminated, p, scratch.yf, f, _COLUMN)
        _eliminate_from_poses(count, z0, z1, z2, layout, system, scratch)
        _eliminate_from_intrinsics(count, num_intrinsics, z0, z1, z2, poses, system, scratch)
    return cost


@_helper
def _joint_step(
    p: int,
    damping: float,
    delta: Float64,
    bundle: BundleData,
    state: BundleParameters,
    eliminated: Float64,
    scratch: EliminationBuffers,
) -> float:
    """Compute the step ``-V^-1 (g + W^T delta)`` of a point by back-substitution.

    The step of the point is written to ``scratch.vector``. The array ``scratch.before`` receives
    the cost (-1 if invisible) and depth of each observation.

    Returns:
        Predicted decrease of the cost.
    """
    obs, layout, rotation = bundle.obs, bundle.layout, state.rotations
    g0, g1, g2 = eliminated[p, 6], eliminated[p, 7], eliminated[p, 8]
    for k in range(obs.start[p], obs.start[p + 1]):
        s = linearize_observation(k, p, bundle, state)
        scratch.before[k - obs.start[p], 0] = s.cost if s.visible else -1.0
        scratch.before[k - obs.start[p], 1] = s.z
        image = obs.image[k]
        dx = dy = dz = ds = 0.0
        if layout.pose_slot[image] >= 0:
            n = NUM_IMAGE_PARAMS * layout.pose_slot[image]
            dx = delta[n + 1] * s.qz - delta[n + 2] * s.qy + delta[n + 3]
            dy = delta[n + 2] * s.qx - delta[n] * s.qz + delta[n + 4]
            dz = delta[n] * s.qy - delta[n + 1] * s.qx + delta[n + 5]
            ds = delta[n + LOG_SCALE_IDX]
        camera = layout.camera_of_image[image]
        if s.visible and layout.calibrated[camera]:
            _fill_effects(s, camera, layout, state, scratch.effects)
            for n in range(NUM_INTRINSICS):
                if layout.intrinsic_slot[camera, n] >= 0:
                    row = NUM_IMAGE_PARAMS * layout.num_poses + layout.intrinsic_slot[camera, n]
                    m = scratch.effects[n, 0]
                    dx += (m * s.x + scratch.effects[n, 1]) * delta[row]
                    dy += (m * s.y + scratch.effects[n, 2]) * delta[row]
        ux = s.hxx * dx + s.hxz * dz
        uy = s.hyy * dy + s.hyz * dz
        if s.hxy != 0.0:
            ux += s.hxy * dy
            uy += s.hxy * dx
        uz = s.hxz * dx + s.hyz * dy + s.hzz * dz + s.hzs * ds
        g0 += rotation[image, 0, 0] * ux + rotation[image, 1, 0] * uy + rotation[image, 2, 0] * uz
        g1 += rotation[image, 0, 1] * ux + rotation[image, 1, 1] * uy + rotation[image, 2, 1] * uz
        g2 += rotation[image, 0, 2] * ux + rotation[image, 1, 2] * uy + rotation[image, 2, 2] * uz
    step = scratch.vector
    _point_step(eliminated, p, g0, g1, g2, step)
    predicted = 0.0
    for a in range(3):
        predicted += step[a] * (damping * eliminated[p, 9] * step[a] - eliminated[p, 6 + a])
    return 0.5 * predicted


@_helper
def _look(
    p: int, bundle: BundleData, trial: BundleParameters, scratch: EliminationBuffers
) -> tuple[float, float, bool]:
    """Evaluate the cost of a point after a step, and write the point's normal equations.

    Returns:
        Cost of the point after the step, previous cost of the observations that became invisible,
        and True if no depth of the point decreased below ``MIN_DEPTH_RATIO``.
    """
    obs, before, block = bundle.obs, scratch.before, scratch.block
    cost = lost = 0.0
    safe = True
    for a in range(10):
        block[0, a] = 0.0
    for k in range(obs.start[p], obs.start[p + 1]):
        s = linearize_observation(k, p, bundle, trial)
        cost += s.cost
        _add_point(s, trial.rotations, obs.image[k], block, _ONLY)
        n = k - obs.start[p]
        if before[n, 0] >= 0.0:
            safe = safe and s.z > MIN_DEPTH_RATIO * before[n, 1]
            if not s.visible:
                lost += before[n, 0]
    return cost, lost, safe


@_kernel
def update_points(
    first: int,
    last: int,
    damping: float,
    tolerance: float,
    delta: Float64,
    bundle: BundleData,
    state: BundleParameters,
    trial: BundleParameters,
    eliminated: Float64,
    scratch: EliminationBuffers,
) -> tuple[float, float, float]:
    """Update the points ``first:last`` after a camera step, and then optimize each point alone.

    Optimization of a single point stops if the predicted relative decrease of its cost is below
    ``tolerance``.

    Returns:
        Cost of the visible observations after the update, previous cost of the observations that
        became invisible, and decrease of the cost predicted for the joint step.
    """
    points, step = trial.points, scratch.vector
    total = total_lost = predicted = 0.0
    for p in range(first, last):
        predicted += _joint_step(p, damping, delta, bundle, state, eliminated, scratch)
        for a in range(3):
            points[p, a] = state.points[p, a] + step[a]
        cost, lost, safe = _look(p, bundle, trial, scratch)
        length = 1.0
        while not safe and length > 0.0:
            length = length * STEP_REDUCTION if length > MIN_STEP_LENGTH else 0.0
            for a in range(3):
                points[p, a] = state.points[p, a] + length * step[a]
            cost, lost, safe = _look(p, bundle, trial, scratch)
        for _ in range(MAX_POINT_STEPS if bundle.layout.variable_point[p] else 0):
            block = scratch.block
            if not _invert_factor(block, _ONLY, POINT_STEP_DAMPING):
                break
            gain = _point_step(block, _ONLY, block[0, 6], block[0, 7], block[0, 8], step)
            if not gain > tolerance * cost:
                break
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            for a in range(3):
                points[p, a] += step[a]
            own_cost, own_lost, safe = _look(p, bundle, trial, scratch)
            if not (safe and own_cost < cost and own_lost <= lost):
                points[p, 0], points[p, 1], points[p, 2] = x, y, z
                break
            cost, lost = own_cost, own_lost
        total += cost
        total_lost += lost
    return total, total_lost, predicted


@_kernel
def rotation_from_vector(x: float, y: float, z: float) -> Any:
    """Convert a rotation vector to a rotation matrix by Rodrigues' formula."""
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    if angle < 1e-4:
        a = 1.0 - squared / 6.0
        b = 0.5 - squared / 24.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / squared
    return (
        (1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)),
    )


@_kernel
def update_cameras(
    delta: Float64, layout: ParameterLayout, state: BundleParameters, trial: BundleParameters
) -> None:
    """Apply a camera step ``delta`` to the poses, depth scales and intrinsics of ``trial``."""
    for image in range(len(layout.pose_slot)):
        slot = layout.pose_slot[image]
        if slot < 0:
            continue
        n = NUM_IMAGE_PARAMS * slot
        turn = rotation_from_vector(delta[n], delta[n + 1], delta[n + 2])
        if layout.variable_scale[image]:
            trial.log_scales[image] += delta[n + LOG_SCALE_IDX]
        for a in range(3):
            trial.translations[image, a] += delta[n + 3 + a]
            for b in range(3):
                value = 0.0
                for c in range(3):
                    value += turn[a][c] * state.rotations[image, c, b]
                trial.rotations[image, a, b] = value
    first = NUM_IMAGE_PARAMS * layout.num_poses
    for camera in range(len(layout.intrinsic_slot)):
        for n in range(NUM_INTRINSICS):
            if layout.intrinsic_slot[camera, n] < 0:
                continue
            change = delta[first + layout.intrinsic_slot[camera, n]]
            if n == LOG_FOCAL:
                scale = np.exp(change)
                trial.intrinsics[camera, 0] *= scale
                trial.intrinsics[camera, 1] *= scale
            elif n == LOG_ASPECT:
                trial.intrinsics[camera, 1] *= np.exp(change)
            elif n < DISTORTION:
                trial.intrinsics[camera, n] += change
            else:
                trial.distortion[camera, n - DISTORTION] += change


@_kernel
def assemble_reduced_matrix(
    system: ReducedCameraSystem, boost: Float64, pairs: Int64, out: Float64
) -> None:
    """Assemble the lower triangle of the reduced camera matrix with damping ``boost``."""
    poses = system.border.shape[1] // NUM_IMAGE_PARAMS
    for block in range(len(pairs)):
        i, j = pairs[block]
        for a in range(NUM_IMAGE_PARAMS):
            for b in range(a if i == j else 0, NUM_IMAGE_PARAMS):
                out[NUM_IMAGE_PARAMS * j + b, NUM_IMAGE_PARAMS * i + a] = system.blocks[block, a, b]
    for f in range(len(system.corner)):
        for a in range(NUM_IMAGE_PARAMS * poses):
            out[NUM_IMAGE_PARAMS * poses + f, a] = system.border[f, a]
        for g in range(f + 1):
            out[NUM_IMAGE_PARAMS * poses + f, NUM_IMAGE_PARAMS * poses + g] = system.corner[f, g]
    for a in range(len(boost)):
        out[a, a] += boost[a]


@_kernel
def multiply_pose_pairs(
    first: int, last: int, blocks: Float64, pairs: Int64, x: Float64, out: Float64
) -> None:
    """Multiply the blocks ``first:last`` of pairs of poses and their transposes by ``x`` (7 s,).

    The product is added to ``out`` (7 s,). The diagonal blocks of single poses are left out.
    """
    for n in range(first, last):
        i, j = NUM_IMAGE_PARAMS * pairs[n, 0], NUM_IMAGE_PARAMS * pairs[n, 1]
        if i == j:
            continue
        for a in range(NUM_IMAGE_PARAMS):
            value = 0.0
            for b in range(NUM_IMAGE_PARAMS):
                value += blocks[n, a, b] * x[j + b]
            out[i + a] += value
        for b in range(NUM_IMAGE_PARAMS):
            value = 0.0
            for a in range(NUM_IMAGE_PARAMS):
                value += blocks[n, a, b] * x[i + a]
            out[j + b] += value


@_kernel
def invert_point_blocks(
    first: int,
    last: int,
    damping: float,
    bundle: BundleData,
    state: BundleParameters,
    scratch: EliminationBuffers,
    out: Float64,
) -> None:
    """Invert the damped 3 x 3 blocks ``V + damping I`` of the points ``first:last``."""
    block = scratch.block
    for p in range(first, last):
        for a in range(10):
            block[0, a] = 0.0
        block[0, 0] = block[0, 2] = block[0, 5] = damping
        for k in range(bundle.obs.start[p], bundle.obs.start[p + 1]):
            s = linearize_observation(k, p, bundle, state)
            _add_point(s, state.rotations, bundle.obs.image[k], block, _ONLY)
        if not _invert_factor(block, _ONLY, 0.0):
            # Rounding errors can cancel the damping of a point's unobserved direction.
            _invert_factor(block, _ONLY, 1e-12)
        i00, i10, i11 = block[0, 0], block[0, 1], block[0, 2]
        i20, i21, i22 = block[0, 3], block[0, 4], block[0, 5]
        out[p, 0, 0] = i00 * i00 + i10 * i10 + i20 * i20
        out[p, 1, 1] = i11 * i11 + i21 * i21
        out[p, 2, 2] = i22 * i22
        out[p, 1, 0] = out[p, 0, 1] = i10 * i11 + i20 * i21
        out[p, 2, 0] = out[p, 0, 2] = i20 * i22
        out[p, 2, 1] = out[p, 1, 2] = i21 * i22
