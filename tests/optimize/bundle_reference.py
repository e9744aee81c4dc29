"""Bundle adjustment problems, and their reference solution by Ceres (pycolmap and pyceres)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyceres
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.data.camera_models import (
    NUM_DISTORTION,
    NUM_INTRINSICS,
    CameraModel,
    intrinsic_parameters,
)
from mpsfm_core.optimize.bundle_adjustment import BundleProblem
from mpsfm_core.optimize.options import SOFT_L1_OPTIONS, BundleOptions

SIZE = (1600, 1200)
FOCAL = 1300.0


def soft_l1(**changes: Any) -> BundleOptions:
    """Return the options that COLMAP's loss needs, with changes."""
    return SOFT_L1_OPTIONS.model_copy(update=changes)


def rotation(vector: Float64) -> Float64:
    """Return the rotation matrix of a rotation vector."""
    matrix: Float64 = pycolmap.Rotation3d(np.asarray(vector, dtype=np.float64)).matrix()
    return matrix


def make_problem(images: int, points: int, track: float, seed: int = 0) -> BundleProblem:
    """Create cameras that move past a slab of points, each observed by neighboring images.

    Cameras and points are true; measurements have noise of 1 px with 3 % outliers, and of 5 % in
    depth with heavy tails. All images share a camera, and the first pose is constant. ``track`` is
    the mean track length.
    """
    rng = np.random.default_rng(seed)
    length = np.clip(rng.poisson(track - 2, points) + 2, 2, images)
    first = rng.integers(0, images - length + 1)
    obs_point = np.repeat(np.arange(points), length)
    step = np.arange(len(obs_point)) - np.repeat(np.cumsum(length) - length, length)
    obs_image = first[obs_point] + step
    centers = np.stack([0.25 * np.arange(images), *rng.normal(0, 0.1, (2, images))], axis=1)
    rotations = np.stack([rotation(turn) for turn in rng.normal(0, 0.05, (images, 3))])
    middle = centers[:, 0][np.minimum(first + length // 2, images - 1)]
    xyz = rng.uniform([-1.5, -1.5, 3.0], [1.5, 1.5, 8.0], (points, 3))
    xyz[:, 0] += middle
    translations = -np.einsum("nij,nj->ni", rotations, centers)
    in_camera = np.einsum("mij,mj->mi", rotations[obs_image], xyz[obs_point])
    in_camera += translations[obs_image]
    center = np.array(SIZE) / 2
    noise = rng.normal(0, 1, (len(obs_point), 2))
    noise[rng.random(len(noise)) < 0.03] *= 8
    return BundleProblem(
        rotations=rotations,
        translations=translations,
        intrinsics=np.array([[FOCAL, FOCAL, *center]]),
        camera_of_image=np.zeros(images, dtype=np.int64),
        points=xyz,
        obs_image=obs_image,
        obs_point=obs_point,
        obs_xy=FOCAL * in_camera[:, :2] / in_camera[:, 2:] + center + noise,
        obs_log_depth=np.log(in_camera[:, 2]) + 0.05 * rng.standard_t(4, len(obs_point)),
        obs_std_log_depth=0.05,
        variable_pose=np.arange(images) > 0,
    )


def perturb(problem: BundleProblem, seed: int, amount: float = 1.0) -> BundleProblem:
    """Perturb all poses except the first two, and all points, of which 2 % have gross errors."""
    rng = np.random.default_rng(seed)
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    for i in range(2, len(rotations)):
        rotations[i] = rotation(rng.normal(0, 0.004 * amount, 3)) @ rotations[i]
        translations[i] += rng.normal(0, 0.02 * amount, 3)
    std = np.where(rng.random(len(problem.points)) < 0.02, 0.3, 0.03)[:, None] * amount
    points = problem.points + std * rng.normal(size=problem.points.shape)
    return replace(problem, rotations=rotations, translations=translations, points=points)


def without_depth(problem: BundleProblem) -> BundleProblem:
    """Return the problem without depth, in which the pose of the second image fixes the scale."""
    return replace(problem, obs_log_depth=None, scale_anchor=1)


def calibrated(
    problem: BundleProblem,
    model: CameraModel,
    *,
    principal_point: bool = False,
    prior_std: float = np.inf,
    **changes: Any,
) -> BundleProblem:
    """Make the intrinsic parameters of a camera model variable for all cameras.

    Args:
        problem: Bundle adjustment problem.
        model: Camera model.
        principal_point: Make the principal point variable, too.
        prior_std: Standard deviation of the zero-mean prior on distortion coefficients, and of the
            prior on the other intrinsic parameters.
        changes: Other fields of the problem to replace.
    """
    cameras = len(problem.intrinsics)
    free = model.free_parameters(principal_point=principal_point)
    mean = intrinsic_parameters(problem.intrinsics, None)
    start = {"distortion": np.zeros((cameras, NUM_DISTORTION))} if model.num_distortion else {}
    return replace(
        problem,
        **{
            "variable_intrinsics": np.tile(free, (cameras, 1)),
            "prior_intrinsics": mean,
            "prior_std_intrinsics": prior_std,
            "fisheye": np.full(cameras, model.is_fisheye),
            **start,
            **changes,
        },
    )


def distorted(
    problem: BundleProblem, coefficients: Sequence[float], *, fisheye: bool = False
) -> BundleProblem:
    """Replace the observations by those of distorted cameras with the same keypoint noise.

    Args:
        problem: Bundle adjustment problem.
        coefficients: First distortion coefficients of all cameras.
        fisheye: Use OPENCV_FISHEYE.
    """
    noise = whitened_residuals(problem, robust=False)[:, :2]
    distortion = np.zeros((len(problem.intrinsics), NUM_DISTORTION))
    distortion[:, : len(coefficients)] = coefficients
    bent = replace(
        problem, distortion=distortion, fisheye=np.full(len(problem.intrinsics), fisheye)
    )
    exact = bent.obs_xy + whitened_residuals(bent, robust=False)[:, :2]
    return replace(bent, obs_xy=exact - noise)


def colmap_model(problem: BundleProblem) -> CameraModel:
    """Return the COLMAP camera model whose parameters are the intrinsics of a problem."""
    variable = problem.variable_intrinsics
    free = np.zeros(NUM_INTRINSICS, bool) if variable is None else variable.any(axis=0)
    if problem.fisheye is not None and problem.fisheye.any():
        return CameraModel.OPENCV_FISHEYE
    if problem.distortion is not None:
        count = max(np.flatnonzero((problem.distortion != 0).any(axis=0) | free[4:]), default=0)
        models = CameraModel.SIMPLE_RADIAL, CameraModel.RADIAL, CameraModel.OPENCV
        return models[min(count, 2)]
    if (problem.intrinsics[:, 0] != problem.intrinsics[:, 1]).any() or free[1]:
        return CameraModel.PINHOLE
    return CameraModel.SIMPLE_PINHOLE


def to_pycolmap(problem: BundleProblem) -> pycolmap.Reconstruction:
    """Convert a problem to a COLMAP reconstruction, whose ids are the indices plus 1."""
    rec = pycolmap.Reconstruction()
    model = colmap_model(problem)
    distortion = problem.distortion
    if distortion is None:
        distortion = np.zeros((len(problem.intrinsics), NUM_DISTORTION))
    for number, intrinsics in enumerate(problem.intrinsics, start=1):
        params = model.to_params(intrinsics, distortion[number - 1])
        rec.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model=model.value, width=SIZE[0], height=SIZE[1], params=params, camera_id=number
            )
        )
    row = np.empty(len(problem.obs_image), dtype=np.int64)
    for i in range(len(problem.rotations)):
        mine = np.flatnonzero(problem.obs_image == i)
        row[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=str(i),
            keypoints=problem.obs_xy[mine],
            camera_id=int(problem.camera_of_image[i]) + 1,
            image_id=i + 1,
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(problem.rotations[i]), problem.translations[i])
        rec.add_image_with_trivial_frame(image, pose)
    by_point = np.argsort(problem.obs_point, kind="stable")
    ends = np.searchsorted(problem.obs_point[by_point], np.arange(len(problem.points) + 1))
    for p, xyz in enumerate(problem.points):
        track = pycolmap.Track()
        for k in by_point[ends[p] : ends[p + 1]]:
            track.add_element(int(problem.obs_image[k]) + 1, int(row[k]))
        rec.add_point3D(xyz, track)
    return rec


def ceres_adjuster(
    rec: pycolmap.Reconstruction,
    tolerance: float = 1e-6,
    *,
    refine_focal: bool = False,
    refine_distortion: bool = False,
    refine_principal_point: bool = False,
    fix_scale: bool = True,
) -> Any:
    """Create pycolmap's bundle adjuster with soft-L1 loss and constant first pose (and scale)."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_focal
    options.refine_extra_params = refine_distortion
    options.refine_principal_point = refine_principal_point
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = SOFT_L1_OPTIONS.reprojection_scale
    solver = options.ceres.solver_options
    solver.function_tolerance = tolerance
    solver.gradient_tolerance = min(1e-4, 1e2 * tolerance)
    solver.max_num_iterations = 100 if tolerance >= 1e-6 else 1000
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in rec.images:
        config.add_image(image_id)
    if fix_scale:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    else:
        config.set_constant_rig_from_world_pose(rec.images[1].frame_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, rec)


class LogDepthCost(pyceres.CostFunction):  # type: ignore[misc]
    """Ceres cost (log z - log d - s) / std of a pose (quaternion xyzw, translation), point and
    scale."""

    def __init__(self, log_depth: float, std: float) -> None:
        super().__init__()
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([7, 3, 1])
        self.log_depth = log_depth
        self.std = std

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Ceres' callback."""
        (qx, qy, qz, qw, _, _, tz), (x, y, z), (log_scale,) = parameters
        row = np.array(
            [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)]
        )
        depth = row @ (x, y, z) + tz
        off = np.log(depth) - self.log_depth - log_scale if depth > 0 else 0.0
        residuals[0] = off / self.std
        scale = 1 / (depth * self.std) if depth > 0 else 0.0
        if jacobians is not None and jacobians[0] is not None:
            by_quaternion = [
                2 * qz * x + 2 * qw * y - 4 * qx * z,
                -2 * qw * x + 2 * qz * y - 4 * qy * z,
                2 * qx * x + 2 * qy * y,
                -2 * qy * x + 2 * qx * y,
            ]
            jacobians[0][:] = scale * np.array([*by_quaternion, 0, 0, 1])
        if jacobians is not None and jacobians[1] is not None:
            jacobians[1][:] = scale * row
        if jacobians is not None and jacobians[2] is not None:
            jacobians[2][:] = -1 / self.std if depth > 0 else 0.0
        return True


class ScaleCost(pyceres.CostFunction):  # type: ignore[misc]
    """Ceres cost (s - expected) / std of a log scale s."""

    def __init__(self, expected: float, std: float) -> None:
        super().__init__()
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([1])
        self.expected = expected
        self.std = std

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Ceres' callback."""
        residuals[0] = (parameters[0][0] - self.expected) / self.std
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 1 / self.std
        return True


class IntrinsicCost(pyceres.CostFunction):  # type: ignore[misc]
    """(p[i] - mean) / std, or (log p[0] - mean) / std, of the ``size`` parameters p of a camera."""

    def __init__(self, index: int, mean: float, std: float, size: int) -> None:
        super().__init__()
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([size])
        self.index = index
        self.mean = mean
        self.std = std

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Ceres' callback."""
        value = parameters[0][self.index]
        derivative = 1.0 if self.index else 1 / value
        residuals[0] = ((value if self.index else np.log(value)) - self.mean) / self.std
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 0
            jacobians[0][self.index] = derivative / self.std
        return True


def prior_costs(problem: BundleProblem, model: CameraModel) -> list[list[IntrinsicCost]]:
    """Return the priors on log focal length and distortion of each camera as Ceres residuals."""
    shape = len(problem.intrinsics), NUM_INTRINSICS
    std = np.broadcast_to(problem.prior_std_intrinsics, shape)
    means = problem.prior_intrinsics
    first = 4 if model.has_aspect else 3
    size = first + model.num_distortion
    columns = [0, *range(4, 4 + model.num_distortion)]
    indices = [0, *range(first, size)]
    return [
        [
            IntrinsicCost(index, float(means[camera, column]), float(std[camera, column]), size)
            for index, column in zip(indices, columns, strict=True)
            if means is not None and np.isfinite(std[camera, column])
        ]
        for camera in range(shape[0])
    ]


def solve_with_ceres(
    problem: BundleProblem,
) -> tuple[float, float, pycolmap.Reconstruction, Float64]:
    """Solve a problem with Ceres; return initial and final cost, reconstruction and log scales
    (n,).

    All poses except the first and all points are variable, as in :func:`make_problem`.
    """
    rec = to_pycolmap(problem)
    plain = problem.obs_log_depth is None
    count = len(problem.rotations)
    given = np.zeros(count) if problem.log_scales is None else problem.log_scales
    log_scales = [np.array([value]) for value in given]
    variable = problem.variable_intrinsics
    free = np.zeros(NUM_INTRINSICS, bool) if variable is None else variable.any(axis=0)
    adjuster = ceres_adjuster(
        rec,
        1e-13,
        refine_focal=bool(free[0]),
        refine_distortion=bool(free[4:].any()),
        refine_principal_point=bool(free[2]),
        fix_scale=plain,
    )
    priors = prior_costs(problem, colmap_model(problem)) if variable is not None else []
    for number, costs in enumerate(priors, start=1):
        for cost in costs:
            adjuster.problem.add_residual_block(cost, None, [rec.cameras[number].params])
    if not plain:
        ceres = adjuster.problem
        loss = pyceres.LossFunction({"name": "cauchy", "params": [SOFT_L1_OPTIONS.depth_scale]})
        std = np.broadcast_to(problem.obs_std_log_depth, len(problem.obs_log_depth))
        keep = [loss]
        for k in np.flatnonzero(np.isfinite(problem.obs_log_depth)):
            pose = rec.images[int(problem.obs_image[k]) + 1].frame.rig_from_world.params
            point = rec.points3D[int(problem.obs_point[k]) + 1].xyz
            keep.append(LogDepthCost(problem.obs_log_depth[k], std[k]))
            scale = log_scales[int(problem.obs_image[k])]
            ceres.add_residual_block(keep[-1], loss, [pose, point, scale])
        # adding a residual makes a constant pose variable
        ceres.set_parameter_block_constant(rec.images[1].frame.rig_from_world.params)
        free = np.zeros(count, bool) if problem.variable_scale is None else problem.variable_scale
        expected = np.zeros(count)
        if problem.expected_log_scales is not None:
            expected = problem.expected_log_scales
        for i, scale in enumerate(log_scales):
            if not free[i]:
                ceres.set_parameter_block_constant(scale)
            elif np.isfinite(problem.std_log_scales):
                keep.append(ScaleCost(expected[i], float(problem.std_log_scales)))
                ceres.add_residual_block(keep[-1], None, [scale])
    summary = adjuster.solve().ceres_summary
    return summary.initial_cost, summary.final_cost, rec, np.concatenate(log_scales)


def whitened_residuals(
    problem: BundleProblem, points: Float64 | None = None, *, robust: bool = True
) -> Float64:
    """Compute reprojection and log-depth residuals (m, 3) with numpy, 0 without depth.

    If ``robust`` is set, residuals are multiplied by the square roots of the loss weights at the
    points of ``problem``, so that their Jacobian yields the normal equations.
    """
    if robust:
        fixed = whitened_residuals(problem, robust=False)
        b = SOFT_L1_OPTIONS.reprojection_scale**2
        weight = np.ones_like(fixed)
        weight[:, :2] = (1 + (fixed[:, :2] ** 2).sum(axis=1, keepdims=True) / b) ** -0.25
        weight[:, 2] = (1 + fixed[:, 2] ** 2 / SOFT_L1_OPTIONS.depth_scale**2) ** -0.5
        return weight * whitened_residuals(problem, points, robust=False)
    seen = (problem.points if points is None else points)[problem.obs_point]
    image = problem.obs_image
    in_camera = np.einsum("mij,mj->mi", problem.rotations[image], seen)
    in_camera += problem.translations[image]
    intrinsics = problem.intrinsics[problem.camera_of_image[image]]
    uv = in_camera[:, :2] / in_camera[:, 2:]
    if problem.distortion is not None:
        coefficients = problem.distortion[problem.camera_of_image[image]]
        is_fisheye = problem.fisheye is not None and bool(problem.fisheye.all())
        uv = distort_reference(uv, coefficients, fisheye=is_fisheye)
    xy = intrinsics[:, :2] * uv + intrinsics[:, 2:]
    pixel = (xy - problem.obs_xy) / np.broadcast_to(problem.obs_std_px, len(image))[:, None]
    depth = np.zeros(len(image))
    if problem.obs_log_depth is not None:
        depth = (np.log(in_camera[:, 2]) - problem.obs_log_depth) / problem.obs_std_log_depth
    return np.column_stack([pixel, np.nan_to_num(depth)])


def distort_reference(uv: Float64, coefficients: Float64, *, fisheye: bool) -> Float64:
    """Distort normalized coordinates (m, 2) by coefficients (m, 4), as COLMAP documents."""
    u, v = uv.T
    a, b, c, d = coefficients.T
    r2 = (uv**2).sum(axis=1)
    if fisheye:
        r = np.sqrt(r2)
        t = np.arctan(r)
        bent = t * (1 + a * t**2 + b * t**4 + c * t**6 + d * t**8)
        return uv * np.divide(bent, r, out=np.ones_like(r), where=r > 0)[:, None]
    radial = uv * (1 + a * r2 + b * r2**2)[:, None]
    tangential = [2 * c * u * v + d * (r2 + 2 * u**2), 2 * d * u * v + c * (r2 + 2 * v**2)]
    return np.asarray(radial + np.stack(tangential, axis=1))


def move_intrinsics(problem: BundleProblem, change: Float64) -> BundleProblem:
    """Return the problem with changes (k, 8) added to its intrinsic parameters."""
    scale = np.exp(change[:, :1] + change[:, 1:2] * [0, 1])
    intrinsics = np.hstack([problem.intrinsics[:, :2] * scale, problem.intrinsics[:, 2:]])
    intrinsics[:, 2:] += change[:, 2:4]
    bent = None if problem.distortion is None else problem.distortion + change[:, 4:]
    return replace(problem, intrinsics=intrinsics, distortion=bent)


def dense_information(problem: BundleProblem) -> Float64:
    """J^T J by central differences over free poses (6 each), points and intrinsic parameters.

    The variable intrinsic parameters are sorted by parameter, then by camera. The weights of the
    robust losses are those at the problem's own state.
    """
    poses = np.flatnonzero(problem.variable_pose)
    parameters, cameras = np.nonzero(problem.variable_intrinsics.T)
    sizes = 6 * len(poses), problem.points.size, len(cameras)
    fixed = whitened_residuals(problem, robust=False)
    robust = whitened_residuals(problem)
    weight = np.divide(robust, fixed, out=np.ones_like(fixed), where=fixed != 0)

    def residuals(change: Float64) -> Float64:
        pose, point, intrinsic = np.split(change, np.cumsum(sizes)[:-1])
        rotations, translations = problem.rotations.copy(), problem.translations.copy()
        for row, step in zip(poses, pose.reshape(-1, 6), strict=True):
            rotations[row] = rotation(step[:3]) @ rotations[row]
            translations[row] += step[3:]
        by_camera = np.zeros((len(problem.intrinsics), NUM_INTRINSICS))
        by_camera[cameras, parameters] = intrinsic
        moved = replace(
            move_intrinsics(problem, by_camera),
            rotations=rotations,
            translations=translations,
            points=problem.points + point.reshape(-1, 3),
        )
        return (weight * whitened_residuals(moved, robust=False)).ravel()

    columns = []
    for n in range(sum(sizes)):
        change = np.zeros(sum(sizes))
        change[n] = 1e-6
        columns.append((residuals(change) - residuals(-change)) / 2e-6)
    jacobian = np.stack(columns, axis=1)
    information: Float64 = jacobian.T @ jacobian
    return information


def dense_point_information(problem: BundleProblem) -> Float64:
    """Compute J^T J (3p, 3p) of all points by central differences, with robust weights."""
    count = problem.points.size
    jacobian = np.empty((3 * len(problem.obs_image), count))
    for n in range(count):
        change = np.zeros(count)
        change[n] = 1e-5
        ahead, behind = (
            whitened_residuals(problem, problem.points + sign * change.reshape(-1, 3))
            for sign in (1, -1)
        )
        jacobian[:, n] = ((ahead - behind) / 2e-5).ravel()
    information: Float64 = jacobian.T @ jacobian
    return information
