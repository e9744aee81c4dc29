"""Prediction of the errors of poses and intrinsics that an incomplete camera model causes.

Bundle adjustment minimizes the reprojection error for a restricted camera model: principal points
are constant, images share a camera, and weak intrinsics keep their guesses. An extended camera
model adds principal points, two radial coefficients per camera, and deviations of focal length and
principal point per image, each with a zero-mean normal prior (additional parameters; Triggs et al.,
"Bundle Adjustment -- A Modern Synthesis", 2000). One Newton step from the solution of the
restricted model predicts the estimates of the extended model. The covariance of the extended model
predicts the remaining uncertainty.

The prior of an image's deviations is a mixture of small deviations of a lens, and large deviations
of an edited image that was zoomed or cropped ("spike and slab"; George and McCulloch, "Variable
Selection via Gibbs Sampling", 1993). The probability that an image is edited follows from the Bayes
factor of both priors with even prior odds (Kass and Raftery, "Bayes Factors", 1995). Errors of
poses are predicted with a normal prior with the variance of the mixture. Errors of intrinsics,
which all images of a camera share, are predicted with the deviations of a lens.

With the Gauss-Newton matrix ``H`` and gradient ``g`` of the reprojection errors, those of depth
``D`` and ``d``, and the precision ``P`` of the priors, the Newton step is ``-C (c g / v + d + P
q)``, where ``q`` are the deviations of the parameters from their prior means, and ``C = (H / v + D
+ P)^-1`` is the covariance. The variance factor ``v`` is estimated from the residuals (Foerstner
and Wrobel, "Photogrammetric Computer Vision", 2016, 4.2.3), because the declared keypoint noise
need not be true, and an image with larger residuals has a larger factor. The factors ``v`` and
``c`` account for the curvature of the robust loss (Huber, "Robust Statistics", 1981, 7.6).

A depth map has a smooth error that many pixels share, such as a tilt, whereas bundle adjustment
takes depth errors as independent. Smooth errors with the Jacobian ``S`` of the gradient by their
coefficients move the solution by ``C S``, which adds ``C S S^T C`` to the covariance (a sandwich
covariance; Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986).
They matter where images with two different neighbors join the scales of two image pairs.

A Newton step is too short if the restricted model is far from the minimum of the extended model,
for example in a local minimum with a wrong focal length. Therefore bundle adjustment with the
additional parameters of the cameras starts from the solution, and the larger change counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array, diags_array, vstack
from scipy.special import expit

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.data.camera_models import NUM_INTRINSICS, IntrinsicParameter
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg
from mpsfm_core.geometry.distortion import distort_rays
from mpsfm_core.optimize.bundle_adjustment import BundleResult, adjust_bundle
from mpsfm_core.optimize.bundle_problem import BundleProblem
from mpsfm_core.optimize.losses import LOSSES
from mpsfm_core.optimize.options import BundleOptions, Loss

FOCAL = IntrinsicParameter.FOCAL_LENGTH
CENTER = [IntrinsicParameter.PRINCIPAL_POINT_X, IntrinsicParameter.PRINCIPAL_POINT_Y]
RADIAL = [IntrinsicParameter.RADIAL_DISTORTION, IntrinsicParameter.DISTORTION_2]
CENTER_STD = 0.02
"""Standard deviation of the principal point from the image center, in longer image sides.
[tuned: benchmarks.verdicts]"""
LENS_DEVIATIONS = (0.002, 0.001)
EDIT_DEVIATIONS = (0.05, 0.02)
"""Standard deviations of an image's log focal length and principal point, in longer image sides,
from those of its shared camera. Autofocus and optical stabilization of a lens cause small
deviations, zooming and cropping large deviations. [tuned: benchmarks.verdicts]"""
SMOOTH_STD = 0.8
"""Standard deviation of each coefficient of the smooth error of a depth map, in standard deviations
of its depth. [tuned: depth maps of rendered_kitchen, see benchmarks/results/verdicts.md]"""
NUM_SMOOTH = 5
"""Number of linear and quadratic functions that describe the smooth error of a depth map."""
MIXTURE_ITERATIONS = 3
"""Number of updates of the probabilities that images are edited. [ours]"""
RADIAL_STDS = (0.1, 0.05)
"""Standard deviations of the radial coefficients ``k1`` and ``k2``. [tuned: benchmarks.verdicts]"""
MAX_IMAGES = 300
"""Maximum number of images for a prediction, whose run time is cubic in the number of images.
[ours]"""
CHUNK_ROWS = 1500
"""Number of point coordinates that are eliminated at a time. [ours]"""
MAX_OTHER_IMAGES = 50
"""Maximum number of other images that the pose of an image is compared with. [ours]"""
MAX_ERROR_DEG = 180.0
"""Upper bound of predicted rotation and direction errors, because linearized errors are
unbounded."""
MIN_VARIANCE_FACTOR = 1e-3
"""Smallest variance factor, a keypoint noise of 3 % of the declared noise. [ours]"""
MIN_DAMPING = 1e-12
"""Smallest relative damping of camera parameters, which makes their information invertible."""
POINT_DAMPING = 1e-8
"""Relative damping of the information matrix of a point, which makes the matrix invertible."""
STEP = 1e-6
"""Step in normalized coordinates of numerical derivatives of the lens distortion."""


@dataclass(frozen=True, eq=False)
class CalibrationErrors:
    """Predicted errors of poses and intrinsics, as root mean squares."""

    pose_deg: Float64
    """(n,) median over the other images of the relative pose error, in degrees. A relative pose
    error is the maximum of the rotation error and the translation direction error."""
    log_focal: Float64
    """(n,) error of the log focal length of each image, 0 for known focal lengths."""
    radial: Float64
    """(k,) error of the radial distortion coefficient of each camera, 0 for known cameras."""


class _Columns(NamedTuple):
    """First column of each kind of parameter in the Jacobian."""

    pose: int
    scale: int
    focal: int
    radial: int
    center: int
    focal_deviation: int
    center_deviation: int
    point: int
    end: int


class _NormalEquations(NamedTuple):
    """Normal equations of the camera parameters after the elimination of points."""

    information: Float64
    """(c, c) Gauss-Newton matrix, whose reprojection part is divided by the variance factor."""
    gradient: Float64
    """(c,) gradient of the cost, scaled to a Newton step with ``information``."""
    by_smooth: Float64
    """(c, 5n) change of the gradient by a standard deviation of each smooth depth error."""


def predict_calibration_errors(
    problem: BundleProblem,
    options: BundleOptions,
    known: Bool,
    sizes: Float64,
    depth_std_ratio: float = 1.0,
) -> CalibrationErrors | None:
    """Predict the errors of poses and intrinsics by an extended camera model.

    Args:
        problem: Solved bundle adjustment problem with priors of the focal lengths.
        options: Options of bundle adjustment with the robust losses.
        known: (k,) bool, True for cameras with known intrinsics, which are not extended.
        sizes: (k, 2) image width and height of each camera in pixels.
        depth_std_ratio: Ratio of the standard deviation of depth to ``obs_std_log_depth``, which is
            larger in bundle adjustment because errors of neighboring pixels correlate.

    Returns:
        The predicted errors, or None for more than ``MAX_IMAGES`` images, no variable pose or no
        observed point.
    """
    num_images, num_cameras = len(problem.rotations), len(problem.intrinsics)
    moving = problem.variable_pose
    if num_images > MAX_IMAGES or moving is None or not moving.any() or not len(problem.points):
        return None
    columns = _number_columns(num_images, num_cameras, len(problem.points))
    extended, longer_sides = not known.all(), sizes.max(axis=1)
    equations = _linearize(
        problem, options, columns, sizes, SMOOTH_STD * depth_std_ratio, extended=extended
    )
    offsets = _prior_offsets(problem, columns)
    lens_stds, edit_stds = (
        _prior_stds(problem, columns, known, longer_sides, deviation_stds)
        for deviation_stds in (LENS_DEVIATIONS, EDIT_DEVIATIONS)
    )
    if not extended:  # The solution is the minimum for known intrinsics.
        equations = equations._replace(gradient=np.zeros(columns.point))
    step, covariance = pose_step, pose_covariance = _predict_errors(equations, lens_stds, offsets)
    if extended:
        mixed_stds = _mix_prior_stds(equations, offsets, lens_stds, edit_stds, columns)
        pose_step, pose_covariance = _predict_errors(equations, mixed_stds, offsets)
    changes = _measure_changes(problem, options, known, longer_sides)
    focal = columns.focal + np.asarray(problem.camera_of_image)
    deviation = columns.focal_deviation + np.arange(num_images)
    log_focal = np.maximum(step[focal] ** 2, changes.log_focal**2) + covariance[focal, focal]
    log_focal += covariance[deviation, deviation] + 2 * covariance[focal, deviation]
    radial = columns.radial + np.arange(num_cameras)
    pose_deg = _measure_pose_errors(problem, pose_step[: 6 * num_images], pose_covariance)
    return CalibrationErrors(
        pose_deg=np.maximum(pose_deg, changes.pose_deg),
        log_focal=np.sqrt(np.maximum(log_focal, 0.0)),
        radial=np.sqrt(
            np.maximum(step[radial] ** 2, changes.radial**2) + covariance[radial, radial]
        ),
    )


def _measure_changes(
    problem: BundleProblem, options: BundleOptions, known: Bool, longer_sides: Float64
) -> CalibrationErrors:
    """Measure the changes of poses and intrinsics in bundle adjustment of the extended model.

    This extended model has principal points and radial coefficients, but no deviations of images.
    """
    cameras = np.asarray(problem.camera_of_image)
    num_images, num_cameras = len(cameras), len(known)
    if known.all():
        return CalibrationErrors(np.zeros(num_images), np.zeros(num_images), np.zeros(num_cameras))
    variable = np.zeros((num_cameras, NUM_INTRINSICS), dtype=np.bool_)
    variable[:, [FOCAL, *CENTER, *RADIAL]] = ~known[:, None]
    stds = np.array(np.broadcast_to(problem.prior_std_intrinsics, variable.shape))
    stds[:, CENTER] = CENTER_STD * longer_sides[:, None]
    stds[:, RADIAL] = RADIAL_STDS
    extended = replace(problem, variable_intrinsics=variable, prior_std_intrinsics=stds)
    result = adjust_bundle(extended, options)
    before = np.zeros(num_cameras) if problem.distortion is None else problem.distortion[:, 0]
    return CalibrationErrors(
        _measure_pose_changes(problem, result),
        np.log(result.intrinsics[:, 0] / problem.intrinsics[:, 0])[cameras],
        result.distortion[:, 0] - before,
    )


def _measure_pose_changes(problem: BundleProblem, result: BundleResult) -> Float64:
    """Return the median change of the relative poses (n,) of each image in degrees."""
    rotations, directions = _relative_poses(problem.rotations, problem.translations)
    new_rotations, new_directions = _relative_poses(result.rotations, result.translations)
    turns = rotation_angle_deg(new_rotations @ rotations.swapaxes(-1, -2))
    changes = np.maximum(turns, angle_between_deg(new_directions, directions))
    changes[np.diag_indices(len(changes))] = np.nan
    return np.asarray(np.nanmedian(changes, axis=1))


def _relative_poses(rotations: Float64, translations: Float64) -> tuple[Float64, Float64]:
    """Return relative rotations (n, n, 3, 3), and baselines (n, n, 3) in the first camera."""
    centers = -np.einsum("nji,nj->ni", rotations, translations)
    baselines = np.einsum("aij,abj->abi", rotations, centers[None] - centers[:, None])
    return rotations[None] @ rotations[:, None].swapaxes(-1, -2), baselines


def _prior_offsets(problem: BundleProblem, columns: _Columns) -> Float64:
    """Return the deviations (c,) of the camera parameters from their prior means."""
    offsets = np.zeros(columns.point)
    cameras = np.arange(len(problem.intrinsics))
    if problem.distortion is not None:
        offsets[columns.radial + cameras] = problem.distortion[:, 0]
        offsets[columns.radial + len(cameras) + cameras] = problem.distortion[:, 1]
    if problem.prior_intrinsics is not None:
        log_focals = np.log(problem.intrinsics[:, 0])
        offsets[columns.focal + cameras] = log_focals - problem.prior_intrinsics[:, 0]
    return offsets


def _number_columns(num_images: int, num_cameras: int, num_points: int) -> _Columns:
    """Return the first column of each kind of parameter."""
    n, k = num_images, num_cameras
    counts = [6 * n, n, k, 2 * k, 2 * k, n, 2 * n, 3 * num_points]
    return _Columns(*np.cumsum([0, *counts]).tolist())


def _prior_stds(
    problem: BundleProblem,
    columns: _Columns,
    known: Bool,
    longer_sides: Float64,
    deviation_stds: tuple[float, float],
) -> Float64:
    """Return the prior standard deviations (c,) of the camera parameters.

    Constant parameters have the standard deviation 0, parameters without prior an infinite one.

    Args:
        problem: Bundle adjustment problem.
        columns: First column of each kind of parameter.
        known: (k,) bool, True for cameras with known intrinsics.
        longer_sides: (k,) longer image side of each camera in pixels.
        deviation_stds: Standard deviations of an image's log focal length, and of its principal
            point in longer image sides, from those of its shared camera.
    """
    num_images, num_cameras = len(problem.rotations), len(known)
    std = np.zeros(columns.point)
    assert problem.variable_pose is not None
    std[: columns.scale] = np.where(np.repeat(problem.variable_pose, 6), np.inf, 0.0)
    if problem.scale_anchor is not None:
        std[6 * problem.scale_anchor + 3 + _find_scale_gauge(problem)] = 0.0
    if problem.variable_scale is not None:
        scale_std = np.broadcast_to(problem.std_log_scales, (num_images,))
        std[columns.scale : columns.focal] = np.where(problem.variable_scale, scale_std, 0.0)
    shape = num_cameras, NUM_INTRINSICS
    focal_std = np.broadcast_to(problem.prior_std_intrinsics, shape)[:, FOCAL]
    std[columns.focal : columns.radial] = np.where(known, 0.0, focal_std)
    radial_std = np.where(known, 0.0, np.array(RADIAL_STDS)[:, None])
    std[columns.radial : columns.center] = radial_std.ravel()
    center_std = np.where(known, 0.0, CENTER_STD * longer_sides)
    std[columns.center : columns.focal_deviation] = np.tile(center_std, 2)
    cameras = np.asarray(problem.camera_of_image)
    is_shared = (np.bincount(cameras, minlength=num_cameras)[cameras] > 1) & ~known[cameras]
    focal_deviation, center_deviation = deviation_stds
    std[columns.focal_deviation : columns.center_deviation] = focal_deviation * is_shared
    std[columns.center_deviation :] = np.tile(
        center_deviation * longer_sides[cameras] * is_shared, 2
    )
    return std


def _find_scale_gauge(problem: BundleProblem) -> int:
    """Return the coordinate of the anchor's translation that is most sensitive to the scale."""
    assert problem.variable_pose is not None and problem.scale_anchor is not None
    first, anchor = int(np.argmin(problem.variable_pose)), problem.scale_anchor
    center = -problem.rotations[first].T @ problem.translations[first]
    offset = problem.rotations[anchor] @ center + problem.translations[anchor]
    return int(np.argmax(np.abs(offset)))


def _mix_prior_stds(
    equations: _NormalEquations,
    offsets: Float64,
    lens_stds: Float64,
    edit_stds: Float64,
    columns: _Columns,
) -> Float64:
    """Return prior standard deviations (c,) that mix those of lenses and of edited images.

    The Bayes factor of an image compares the evidence of both priors for the deviations of this
    image, given the mixed priors of all other images. The iteration starts with the prior of edited
    images for all images.

    Args:
        equations: Normal equations of the camera parameters.
        offsets: Deviations (c,) of the camera parameters from their prior means.
        lens_stds: Prior standard deviations (c,) with the deviations of a lens.
        edit_stds: Prior standard deviations (c,) with the deviations of edited images.
        columns: First column of each kind of parameter.
    """
    num_images = columns.center_deviation - columns.focal_deviation
    rows = np.arange(columns.focal_deviation, columns.point).reshape(3, num_images).T
    rows = rows[edit_stds[rows[:, 0]] > 0]
    edit, lens = edit_stds[rows] ** 2, lens_stds[rows] ** 2
    mixed: Float64 = edit_stds.copy()
    for _ in range(MIXTURE_ITERATIONS):
        step, covariance = _compute_posterior(equations, mixed, offsets)
        precision = np.linalg.inv(covariance[rows[:, :, None], rows[:, None]])
        vector = np.einsum("nij,nj->ni", precision, step[rows])
        log_edit, log_lens = (
            _log_evidence(precision, vector, mixed[rows] ** 2, prior) for prior in (edit, lens)
        )
        probability = expit(log_edit - log_lens)[:, None]
        mixed[rows] = np.sqrt(probability * edit + (1 - probability) * lens)
    return mixed


def _log_evidence(precision: Float64, vector: Float64, used: Float64, prior: Float64) -> Float64:
    """Return the log evidence (n,) of normal priors, up to a constant for each image.

    Args:
        precision: Posterior precision (n, d, d) of the deviations of each image.
        vector: Product (n, d) of posterior precision and posterior mean.
        used: Prior variances (n, d) of this posterior.
        prior: Prior variances (n, d) whose evidence is computed.
    """
    changed = precision + (1 / prior - 1 / used)[:, None] * np.eye(prior.shape[1])
    mean = np.linalg.solve(changed, vector[:, :, None])[:, :, 0]
    log_determinant = np.linalg.slogdet(changed)[1] + np.log(prior).sum(axis=1)
    evidence: Float64 = ((vector * mean).sum(axis=1) - log_determinant) / 2
    return evidence


def _predict_errors(
    equations: _NormalEquations, std: Float64, offsets: Float64
) -> tuple[Float64, Float64]:
    """Return the Newton step (c,) and the covariance (c, c) with smooth errors of depth maps."""
    step, covariance = _compute_posterior(equations, std, offsets)
    by_smooth = covariance @ equations.by_smooth
    return step, covariance + by_smooth @ by_smooth.T


def _compute_posterior(
    equations: _NormalEquations, std: Float64, offsets: Float64
) -> tuple[Float64, Float64]:
    """Return the Newton step (c,) and covariance (c, c) of the camera parameters.

    Step and covariance of constant parameters are 0.
    """
    free = np.flatnonzero(std > 0)
    step, covariance = np.zeros(len(std)), np.zeros((len(std), len(std)))
    gradient = equations.gradient[free] + offsets[free] / std[free] ** 2
    solution = _solve(
        equations.information, std, free, np.column_stack([np.eye(len(free)), -gradient])
    )
    covariance[np.ix_(free, free)], step[free] = solution[:, :-1], solution[:, -1]
    return step, covariance


def _solve(information: Float64, std: Float64, free: Int64, right: Float64) -> Float64:
    """Solve for the free parameters by the sum of information and prior precision.

    Args:
        information: Information matrix (c, c) of all camera parameters.
        std: Prior standard deviations (c,) of all camera parameters.
        free: Indices (f,) of the free parameters.
        right: Right-hand sides (f, r).

    Returns:
        The solutions (f, r).
    """
    matrix = information[np.ix_(free, free)]
    diagonal = np.diagonal(matrix) + 1.0 / std[free] ** 2
    # Unobserved parameters without prior stay constant.
    diagonal = np.where(diagonal > 0, diagonal, 1.0)
    scale = 1.0 / np.sqrt(diagonal)[:, None]
    matrix *= scale.T * scale
    damping = MIN_DAMPING
    while True:
        matrix[np.diag_indices(len(free))] = 1.0 + damping
        try:
            factor = cho_factor(matrix)
        except LinAlgError:
            damping *= 10  # rounding errors exceed the smallest eigenvalue
            continue
        solution: Float64 = scale * cho_solve(factor, scale * right)
        return solution


def _linearize(
    problem: BundleProblem,
    options: BundleOptions,
    columns: _Columns,
    sizes: Float64,
    smooth_std: float,
    *,
    extended: bool,
) -> _NormalEquations:
    """Linearize the residuals at the solution, eliminate points, and scale by the variance.

    Args:
        problem: Solved bundle adjustment problem.
        options: Options of bundle adjustment with the robust losses.
        columns: First column of each kind of parameter.
        sizes: (k, 2) image width and height of each camera in pixels.
        smooth_std: Standard deviation of the coefficients of smooth depth errors, relative to
            ``obs_std_log_depth``.
        extended: False if all intrinsics are known. The Jacobian then excludes intrinsics.
    """
    seen = _Observations(problem)
    jacobian, residuals = _linearize_reprojection(
        problem, options, columns, seen, extended=extended
    )
    by_smooth = csr_array((columns.end, 0))
    if problem.obs_log_depth is not None:
        depth_jacobian, depth_residuals, weight = _linearize_depth(problem, options, columns, seen)
        smooth = _evaluate_smooth_errors(problem, seen, sizes) * (smooth_std * weight)[:, None]
        images = NUM_SMOOTH * seen.image[:, None] + np.arange(NUM_SMOOTH)
        by_smooth = csr_array(
            depth_jacobian.T
            @ _to_sparse(smooth[:, None], images[:, None], NUM_SMOOTH * len(problem.rotations))
        )
        jacobian = csr_array(vstack([jacobian, depth_jacobian]))
        residuals = np.concatenate([residuals, depth_residuals])
    precision, deviations = _scale_prior(problem)
    prior, gradient = np.zeros(columns.end), jacobian.T @ residuals
    prior[columns.scale : columns.focal] = precision
    gradient[columns.scale : columns.focal] += precision * deviations
    hessian = csr_array(jacobian.T @ jacobian + diags_array(prior))
    return _eliminate_points(hessian, gradient, by_smooth, columns.point)


def _eliminate_points(
    hessian: csr_array, gradient: Float64, by_smooth: csr_array, first: int
) -> _NormalEquations:
    """Return the normal equations of the camera parameters by the Schur complement.

    Args:
        hessian: Gauss-Newton matrix of camera parameters and points.
        gradient: Gradient by camera parameters and points.
        by_smooth: Change of the gradient by the smooth errors of depth maps.
        first: First column of the points.
    """
    factor = _factorize_inverses(csr_array(hessian[first:, first:]))
    coupling = csr_array(factor @ hessian[first:, :first])
    information = hessian[:first, :first].toarray()
    for start in range(0, coupling.shape[0], CHUNK_ROWS):
        rows = coupling[start : start + CHUNK_ROWS]
        used = np.unique(rows.indices)
        dense = rows[:, used].toarray()
        information[np.ix_(used, used)] -= dense.T @ dense
    reduced = gradient[:first] - coupling.T @ (factor @ gradient[first:])
    by_smooth = by_smooth[:first] - coupling.T @ (factor @ by_smooth[first:])
    return _NormalEquations(information, reduced, by_smooth.toarray())


def _scale_prior(problem: BundleProblem) -> tuple[Float64, Float64]:
    """Return the precision (n,) of the log depth scales, and their deviations from the prior."""
    count = len(problem.rotations)
    std = np.broadcast_to(np.asarray(problem.std_log_scales, dtype=np.float64), (count,))
    zero = np.zeros(count)
    log_scales = zero if problem.log_scales is None else problem.log_scales
    expected = zero if problem.expected_log_scales is None else problem.expected_log_scales
    return 1.0 / std**2, log_scales - expected


class _Observations:
    """Keypoint observations, with the observed 3D points in the frame of the observing camera.

    Attributes:
        rows: (m,) index of each observation in the bundle adjustment problem.
        image: (m,) index of the observing image.
        camera: (m,) index of the observing camera.
        point: (m,) index of the observed point.
        rotation: (m, 3, 3) rotation of the observing image.
        rotated: (m, 3) rotated point ``R X``.
        in_camera: (m, 3) point ``R X + t`` in the camera frame.
    """

    def __init__(self, problem: BundleProblem) -> None:
        image, point = np.asarray(problem.obs_image), np.asarray(problem.obs_point)
        rotated = np.einsum("mij,mj->mi", problem.rotations[image], problem.points[point])
        in_camera = rotated + problem.translations[image]
        visible = in_camera[:, 2] > 0
        self.rows = np.flatnonzero(visible)
        self.image, self.point = image[visible], point[visible]
        self.camera = np.asarray(problem.camera_of_image)[self.image]
        self.rotation = problem.rotations[self.image]
        self.rotated, self.in_camera = rotated[visible], in_camera[visible]


def _linearize_reprojection(
    problem: BundleProblem,
    options: BundleOptions,
    columns: _Columns,
    seen: _Observations,
    *,
    extended: bool,
) -> tuple[csr_array, Float64]:
    """Linearize the weighted reprojection errors by poses, points and intrinsics.

    Without ``extended``, the Jacobian excludes intrinsics.

    Returns:
        Jacobian (2m, parameters) and residuals (2m,), both divided by the square root of the
        variance factor. The residuals are scaled to a Newton step.
    """
    z = seen.in_camera[:, 2:]
    slopes = seen.in_camera[:, :2] / z
    intrinsics = problem.intrinsics[seen.camera]
    inverse_std = 1.0 / np.broadcast_to(problem.obs_std_px, len(problem.obs_image))[seen.rows]
    distorted, derivative = _distort(problem, seen.camera, slopes)
    scale = intrinsics[:, :2] * inverse_std[:, None]
    errors = scale * distorted
    residuals = errors + (intrinsics[:, 2:] - problem.obs_xy[seen.rows]) * inverse_std[:, None]
    squared = (residuals**2).sum(axis=1)
    weight, curvature = _evaluate_loss(
        options.reprojection_loss, options.reprojection_scale, squared
    )
    lengths = np.bincount(seen.point)[seen.point]
    variance_factors, newton_factor = _estimate_factors(
        weight, curvature, squared, lengths, seen.image
    )
    image = seen.image[:, None]
    by_slopes = scale[:, :, None] * derivative
    by_point = (
        np.concatenate([by_slopes, -np.einsum("mij,mj->mi", by_slopes, slopes)[:, :, None]], axis=2)
        / z[:, :, None]
    )
    blocks = [_by_pose(by_point, seen), by_point @ seen.rotation]
    indices = [
        np.repeat((columns.pose + 6 * image + np.arange(6))[:, None], 2, axis=1),
        np.repeat((columns.point + 3 * seen.point[:, None] + np.arange(3))[:, None], 2, axis=1),
    ]
    if extended:
        by_intrinsics, intrinsics_indices = _linearize_intrinsics(
            problem, columns, seen, errors, inverse_std
        )
        blocks.append(by_intrinsics)
        indices.append(intrinsics_indices)
    root = np.sqrt(weight / variance_factors[seen.image])[:, None]
    jacobian = np.concatenate(blocks, axis=2) * root[:, :, None]
    matrix = _to_sparse(jacobian, np.concatenate(indices, axis=2), columns.end)
    return matrix, (newton_factor * residuals * root).ravel()


def _linearize_intrinsics(
    problem: BundleProblem,
    columns: _Columns,
    seen: _Observations,
    errors: Float64,
    inverse_std: Float64,
) -> tuple[Float64, Int64]:
    """Differentiate the reprojection errors by shared intrinsics and by deviations of images.

    Args:
        problem: Bundle adjustment problem.
        columns: First column of each kind of parameter.
        seen: The m observations.
        errors: (m, 2) offsets of the projections from the principal point, in standard deviations.
        inverse_std: (m,) inverse standard deviations of the keypoints in 1/pixels.

    Returns:
        Derivatives (m, 2, 6) and their columns (m, 2, 6): log focal length, two radial
        coefficients, principal point, and the deviations of log focal length and principal point.
    """
    num_images, num_cameras = len(problem.rotations), len(problem.intrinsics)
    slopes = seen.in_camera[:, :2] / seen.in_camera[:, 2:]
    scale = problem.intrinsics[seen.camera, :2] * inverse_std[:, None]
    radius2 = (slopes**2).sum(axis=1, keepdims=True)
    direction = slopes
    if problem.fisheye is not None and problem.fisheye.any():
        # The coefficients of a fisheye camera multiply powers of the angle.
        radius = np.maximum(np.sqrt(radius2), STEP)
        angle, is_fisheye = np.arctan(radius), problem.fisheye[seen.camera, None]
        direction = np.where(is_fisheye, slopes * angle / radius, slopes)
        radius2 = np.where(is_fisheye, angle**2, radius2)
    by_radial = np.stack([scale * direction * radius2, scale * direction * radius2**2], axis=2)
    by_center = np.broadcast_to(inverse_std[:, None, None], (len(slopes), 2, 1))
    by_focal = errors[:, :, None]
    image, camera, axes = seen.image[:, None], seen.camera[:, None], np.arange(2)[None]
    indices = [
        np.repeat((columns.focal + camera)[:, None], 2, axis=1),
        np.repeat((columns.radial + camera + num_cameras * axes)[:, None], 2, axis=1),
        (columns.center + camera + num_cameras * axes)[:, :, None],
        np.repeat((columns.focal_deviation + image)[:, None], 2, axis=1),
        (columns.center_deviation + image + num_images * axes)[:, :, None],
    ]
    jacobian = np.concatenate([by_focal, by_radial, by_center, by_focal, by_center], axis=2)
    return jacobian, np.concatenate(indices, axis=2)


def _linearize_depth(
    problem: BundleProblem, options: BundleOptions, columns: _Columns, seen: _Observations
) -> tuple[csr_array, Float64, Float64]:
    """Linearize the weighted log-depth errors of observations with valid depth.

    Returns:
        Jacobian (m, parameters), residuals (m,), and derivatives (m,) of the residuals by the depth
        error in standard deviations. All are 0 for invalid depth.
    """
    assert problem.obs_log_depth is not None
    z, log_depth = seen.in_camera[:, 2], problem.obs_log_depth[seen.rows]
    valid = np.isfinite(log_depth)
    std = np.broadcast_to(problem.obs_std_log_depth, len(problem.obs_image))[seen.rows]
    log_scale = 0.0 if problem.log_scales is None else problem.log_scales[seen.image]
    inverse_std = np.where(valid, 1.0 / std, 0.0)
    residuals = np.where(valid, np.log(z) - log_depth - log_scale, 0.0) * inverse_std
    weight, _ = _evaluate_loss(options.depth_loss, options.depth_scale, residuals**2)
    by_point = np.zeros((len(z), 1, 3))
    by_point[:, 0, 2] = inverse_std / z
    jacobian = np.concatenate(
        [_by_pose(by_point, seen), -inverse_std[:, None, None], by_point @ seen.rotation], axis=2
    )
    parts = [
        columns.pose + 6 * seen.image[:, None] + np.arange(6),
        columns.scale + seen.image[:, None],
        columns.point + 3 * seen.point[:, None] + np.arange(3),
    ]
    root = np.sqrt(weight)
    indices = np.concatenate(parts, axis=1)[:, None]
    matrix = _to_sparse(jacobian * root[:, None, None], indices, columns.end)
    return matrix, residuals * root, np.where(valid, root, 0.0)


def _evaluate_smooth_errors(problem: BundleProblem, seen: _Observations, sizes: Float64) -> Float64:
    """Evaluate the smooth errors (m, 5) of depth maps at the observations.

    They are the linear and quadratic products of Legendre polynomials, each with a mean square of 1
    in the image.
    """
    u, v = (2 * problem.obs_xy[seen.rows] / sizes[seen.camera] - 1).T
    quadratic = (np.sqrt(5) * (1.5 * x**2 - 0.5) for x in (u, v))
    return np.stack([np.sqrt(3) * u, np.sqrt(3) * v, 3 * u * v, *quadratic], axis=1)


def _distort(problem: BundleProblem, camera: Int64, slopes: Float64) -> tuple[Float64, Float64]:
    """Return distorted normalized coordinates (m, 2), and their derivative (m, 2, 2)."""
    fisheye = np.zeros(len(problem.intrinsics), np.bool_)
    fisheye = fisheye if problem.fisheye is None else problem.fisheye
    if problem.distortion is None or not (problem.distortion.any() or fisheye.any()):
        return slopes, np.broadcast_to(np.eye(2), (len(slopes), 2, 2))
    distorted, derivative = np.empty_like(slopes), np.empty((len(slopes), 2, 2))
    for row, coefficients in enumerate(problem.distortion.tolist()):
        distort = partial(distort_rays, coefficients=coefficients, fisheye=bool(fisheye[row]))
        chosen = camera == row
        distorted[chosen] = distort(slopes[chosen])
        for axis, step in enumerate(STEP * np.eye(2)):
            above, below = (distort(slopes[chosen] + s) for s in (step, -step))
            derivative[chosen, :, axis] = (above - below) / (2 * STEP)
    return distorted, derivative


def _by_pose(by_point: Float64, seen: _Observations) -> Float64:
    """Convert derivatives (m, r, 3) by the camera-frame point to those (m, r, 6) by the pose."""
    # To first order, a rotation by the small vector w moves a rotated point q by ``w x q``.
    by_rotation = np.cross(seen.rotated[:, None], by_point)
    return np.concatenate([by_rotation, by_point], axis=2)


def _evaluate_loss(loss: Loss, scale: float, squared: Float64) -> tuple[Float64, Float64]:
    """Return the IRLS weights and the curvatures of a robust loss at squared residuals.

    The curvature is half the trace of the Hessian of the loss by a residual of two coordinates,
    relative to that of the quadratic loss.
    """
    function, step = LOSSES[loss], 1e-4
    weight: Float64 = function(squared, scale)[1]
    slope = (function(squared * (1 + step), scale)[1] - weight) / step
    return weight, weight + slope


def _estimate_factors(
    weight: Float64, curvature: Float64, squared: Float64, lengths: Int64, image: Int64
) -> tuple[Float64, float]:
    """Estimate the variance factor of each image and the Newton factor of robust residuals.

    An M-estimator has the covariance ``E[psi^2] / E[psi']^2 (J^T J)^-1``, whereas the inverse of
    the IRLS matrix is ``(E[w] J^T J)^-1``. A Newton step is longer than an IRLS step by ``E[w] /
    E[psi']``. A track of ``l`` observations constrains the cameras in ``2 l - 3`` directions. One
    of them is the direction of the residuals, in which the loss has the smallest curvature.

    The variance of an image with few matches may be larger than that of all images (variance
    component estimation; Foerstner and Wrobel, 4.2.4). The larger of both is used.

    Args:
        weight: (m,) IRLS weights.
        curvature: (m,) curvatures, see :func:`_evaluate_loss`.
        squared: (m,) squared residuals.
        lengths: (m,) track lengths.
        image: (m,) index of the observing image.

    Returns:
        Variance factors (n,) of the images, and the Newton factor of all observations.
    """
    num_directions = np.maximum(2 * lengths - 3, 1)
    along_residual = 2 * curvature - weight
    curvature = curvature + (along_residual - curvature) / num_directions
    redundancy = np.maximum(2 * lengths - 3, 0) / lengths
    terms = redundancy, redundancy * weight, redundancy * curvature, weight**2 * squared
    sums = np.array([np.bincount(image, values) for values in terms])
    sums = np.concatenate([sums, sums.sum(axis=1, keepdims=True)], axis=1)
    num_poses = np.append(np.ones(sums.shape[1] - 1), sums.shape[1] - 2)
    total = np.maximum(sums[0], 1e-9)
    mean_weight, mean_curvature = sums[1] / total, np.maximum(sums[2] / total, 1e-3)
    influence = sums[3] / np.maximum(sums[0] - 6 * num_poses, 1)
    variance = np.maximum(influence * mean_weight / mean_curvature**2, MIN_VARIANCE_FACTOR)
    newton_factor = float(mean_weight[-1] / mean_curvature[-1])
    return np.maximum(variance[:-1], variance[-1]), newton_factor


def _to_sparse(values: Float64, indices: Int64, num_columns: int) -> csr_array:
    """Convert values (m, r, e) and their columns (m, r, e) to a sparse matrix with m r rows."""
    num_rows, per_row = values.shape[0] * values.shape[1], values.shape[2]
    starts = np.arange(0, num_rows * per_row + 1, per_row)
    return csr_array((values.ravel(), indices.ravel(), starts), shape=(num_rows, num_columns))


def _factorize_inverses(matrix: csr_array) -> csr_array:
    """Return block-diagonal factors ``L^T`` (3p, 3p) of the inverses ``L L^T`` of point blocks."""
    num_points = matrix.shape[0] // 3
    entries = matrix.tocoo()
    blocks = np.zeros((num_points, 3, 3))
    blocks[entries.row // 3, entries.row % 3, entries.col % 3] = entries.data
    mean = np.trace(blocks, axis1=1, axis2=2) / 3
    boost = np.where(mean > 0, POINT_DAMPING * mean, 1.0)
    inverse = np.linalg.inv(blocks + boost[:, None, None] * np.eye(3))
    factors = np.linalg.cholesky(inverse).transpose(0, 2, 1)
    rows = np.arange(num_points + 1)
    return csr_array(bsr_array((factors, rows[:-1], rows), shape=matrix.shape).tocsr())


def _measure_pose_errors(problem: BundleProblem, step: Float64, covariance: Float64) -> Float64:
    """Return the median root mean square relative pose error (n,) of each image in degrees.

    Args:
        problem: Bundle adjustment problem with the poses.
        step: (6n,) predicted change of the poses.
        covariance: Covariance whose first 6n rows and columns belong to the poses.
    """
    num_images = len(problem.rotations)
    errors = np.zeros(num_images)
    for image in range(num_images):
        others = np.delete(np.arange(num_images), image)
        others = others[:: 1 + len(others) // MAX_OTHER_IMAGES]
        rows = np.repeat(6 * image + np.arange(6)[None], len(others), axis=0)
        rows = np.concatenate([rows, 6 * others[:, None] + np.arange(6)], axis=1)
        squares = []
        for jacobian in _relative_pose_jacobians(problem, image, others):
            change = np.einsum("mij,mj->mi", jacobian, step[rows])
            spread = covariance[rows[:, :, None], rows[:, None]]
            variance = np.einsum("mij,mjk,mik->m", jacobian, spread, jacobian)
            squares.append((change**2).sum(axis=1) + np.maximum(variance, 0.0))
        errors[image] = np.median(np.sqrt(np.maximum(*squares)))
    return np.minimum(np.degrees(errors), MAX_ERROR_DEG)


def _relative_pose_jacobians(
    problem: BundleProblem, image: int, others: Int64
) -> tuple[Float64, Float64]:
    """Return the derivatives of relative poses by the poses of an image and of other images.

    Returns:
        Derivatives (m, 3, 12) of the relative rotation, and of the unit translation direction in
        the frame of ``image``, both by rotation and translation of ``image`` and of the other
        image.
    """
    rotation, translation = problem.rotations[image], problem.translations[image]
    other_rotations, other_translations = problem.rotations[others], problem.translations[others]
    # ``b = t_a - R_a R_b^T t_b`` points from camera a to camera b in the frame of camera a.
    a_from_b = np.einsum("ij,mkj->mik", rotation, other_rotations)
    baseline = translation - np.einsum("mij,mj->mi", a_from_b, other_translations)
    identity = np.broadcast_to(np.eye(3), a_from_b.shape)
    zero = np.zeros_like(a_from_b)
    by_rotation = np.concatenate([-a_from_b.transpose(0, 2, 1), zero, identity, zero], axis=2)
    by_rotations = -_skew(baseline - translation), -a_from_b @ _skew(other_translations)
    by_baseline = np.concatenate([by_rotations[0], identity, by_rotations[1], -a_from_b], axis=2)
    length = np.maximum(np.linalg.norm(baseline, axis=1), 1e-12)[:, None, None]
    direction = baseline[:, :, None] / length
    across = identity - direction @ direction.transpose(0, 2, 1)
    return by_rotation, across @ by_baseline / length


def _skew(vectors: Float64) -> Float64:
    """Return the matrices (m, 3, 3) of the cross products with vectors (m, 3)."""
    matrices: Float64 = np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)
    return matrices
