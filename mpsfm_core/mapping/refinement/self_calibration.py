"""Self-calibration, which accepts or refuses intrinsics that bundle adjustment estimates.

Bundle adjustment estimates log focal lengths with a normal prior, whose standard deviation depends
on the source of the guess (EXIF, a network, or a default). A camera takes the estimated focal
length if the observations determine the focal length better than the prior, and if a lens of this
focal length exists. Guessed focal lengths that a camera keeps are fixed, and the remaining focal
lengths are estimated again. A camera with a refined focal length also takes the other parameters of
its camera model (distortion, aspect ratio and, on request, principal point) that are well
determined and plausible.

The last self-calibration of a reconstruction estimates intrinsics from tracks of three or more
images. Wrong matches of two images are inliers if they agree with the current epipolar geometry,
and so confirm wrong intrinsics. Other tracks only determine cameras that long tracks do not
determine. While images are registered, all tracks count, because too few tracks of a new image are
long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingImage
from mpsfm_core.data.camera_models import IntrinsicParameter, intrinsic_parameters
from mpsfm_core.geometry.focal_length import compute_equivalent_mm, is_plausible_equivalent
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    MIN_FOCAL_IMAGES,
    CalibrationOutcome,
    IntrinsicEstimate,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.optimize.bundle_adjustment import (
    BundleProblem,
    BundleResult,
    adjust_bundle,
    start_at,
)
from mpsfm_core.optimize.options import BundleOptions

MAX_STD_RATIO = 0.5
"""Ratio of posterior and prior standard deviation above which an intrinsic parameter keeps its
guess. At a ratio of 0.5, the observations add three times the information of the prior. [ours]"""
MIN_DEVIATION_FEW_IMAGES = 15.0
"""Smallest deviation of distortion or principal point from the mean of the prior, in posterior
standard deviations, at which a camera of fewer than ``MIN_FOCAL_IMAGES`` images takes the estimate
from all tracks. Wrong matches of two images resemble distortion of many standard deviations.
[tuned: benchmarks.mixed_cameras]"""
MIN_TRACK_LENGTH = 3
"""Smallest number of observations of a long track. [COLMAP ignore_two_view_tracks]"""
SHORT_TRACK_STD_FACTOR = 100.0
"""Factor on the standard deviations of short tracks, whose remaining weight keeps the poses of
images without long tracks determined. [ours]"""
DISTORTION_PRIOR_STD = 0.1
"""Standard deviation of the zero-mean prior on radial distortion coefficients. The coefficient k1
of phones and zoom lenses stays below 0.05 in magnitude, that of action cameras below 0.3. [ours]"""
CORNER_SHIFT_PRIOR_STD = 0.025
"""Standard deviation of the relative shift of the image corners by ``k1``, for long focal lengths.
At a long focal length, a large ``k1`` shifts the image corners only a little. [tuned:
benchmarks.mixed_cameras]"""
TANGENTIAL_PRIOR_STD = 0.01
"""Standard deviation of the zero-mean prior on tangential distortion coefficients. [ours]"""
ASPECT_PRIOR_STD = 0.01
"""Standard deviation of the prior on ``log(fy / fx)``. [ours]"""
PRINCIPAL_POINT_PRIOR_STD = 0.02
"""Standard deviation of the prior on the principal point, relative to the longer image side. The
mean of the prior is the image center. [ours]"""
MAX_PRIOR_DEVIATION = 6.0
"""Largest plausible deviation of an intrinsic parameter from the mean of its prior, in standard
deviations of the prior. The coefficient of SIMPLE_RADIAL may be up to 0.6. [ours]"""
FOCAL = IntrinsicParameter.FOCAL_LENGTH
CENTER = [IntrinsicParameter.PRINCIPAL_POINT_X, IntrinsicParameter.PRINCIPAL_POINT_Y]


def mask_guessed_focals(scene: Scene, images: Int64) -> Bool:
    """Return a bool mask (m,) of the given images whose focal length is a guess."""
    known = [scene.problem.images[image].focal_known for image in images]
    return ~np.array(known, dtype=np.bool_)


def calibrate_cameras(
    scene: Scene,
    problem: BundleProblem,
    options: BundleOptions,
    representatives: Int64,
    *,
    refine_distortion: bool,
    refine_principal_point: bool,
    long_tracks: bool,
) -> BundleResult:
    """Run bundle adjustment with guessed intrinsics, and apply well-determined estimates.

    The other intrinsic parameters of a camera become variable after its focal length is refined,
    because they would otherwise compensate for a wrong focal length. An intrinsic parameter whose
    estimate is implausible or undetermined keeps the guess, and bundle adjustment is repeated with
    this parameter fixed. The outcome of each camera is recorded in the scene.

    Args:
        scene: The scene, which receives the refined intrinsics.
        problem: The bundle adjustment problem with constant intrinsics.
        options: Options of bundle adjustment.
        representatives: (k,) index of one image of each camera of the problem.
        refine_distortion: Refine the distortion of the camera models.
        refine_principal_point: Refine principal points.
        long_tracks: Estimate the intrinsics of a camera from long tracks, if these determine all
            estimated intrinsics of the camera.
    """
    images = [scene.problem.images[image] for image in representatives]
    free = np.array(
        [i.camera_model.free_parameters(principal_point=refine_principal_point) for i in images]
    )
    free[:, IntrinsicParameter.RADIAL_DISTORTION :] &= refine_distortion
    free &= mask_guessed_focals(scene, representatives)[:, None]
    means, stds = compute_intrinsic_priors(images)
    problem = replace(problem, prior_intrinsics=means, prior_std_intrinsics=stds)
    if not long_tracks:
        return _estimate_intrinsics(
            scene, problem, options, representatives, free, MIN_DEVIATION_FEW_IMAGES
        )
    weakened = _weaken_short_tracks(problem)
    result = _estimate_intrinsics(scene, weakened, options, representatives, free, 0.0)
    outcomes = scene.estimated_intrinsics.outcomes[representatives]
    is_undetermined = (free & (outcomes != CalibrationOutcome.REFINED)).any(axis=1)
    return _estimate_intrinsics(
        scene,
        start_at(problem, result),
        options,
        representatives,
        free & is_undetermined[:, None],
        MIN_DEVIATION_FEW_IMAGES,
    )


def _weaken_short_tracks(problem: BundleProblem) -> BundleProblem:
    """Return the problem with larger standard deviations of tracks that are not long."""
    lengths = np.bincount(problem.obs_point)[problem.obs_point]
    factor = np.where(lengths < MIN_TRACK_LENGTH, SHORT_TRACK_STD_FACTOR, 1.0)
    return replace(
        problem,
        obs_std_px=factor * problem.obs_std_px,
        obs_std_log_depth=factor * problem.obs_std_log_depth,
    )


def _estimate_intrinsics(
    scene: Scene,
    problem: BundleProblem,
    options: BundleOptions,
    representatives: Int64,
    free: Bool,
    min_deviation: float,
) -> BundleResult:
    """Run bundle adjustment with variable intrinsics, and apply well-determined estimates.

    Args:
        scene: The scene, which receives the refined intrinsics.
        problem: The bundle adjustment problem with priors on intrinsics.
        options: Options of bundle adjustment.
        representatives: (k,) index of one image of each camera of the problem.
        free: (k, 8) bool, True for the intrinsic parameters to estimate.
        min_deviation: Smallest deviation of distortion or principal point from the mean of the
            prior, in posterior standard deviations, at which a camera of few images takes the
            estimate.
    """
    images = [scene.problem.images[image] for image in representatives]
    estimated, free, active = free, free.copy(), free.copy()
    active[:, 1:] &= scene.estimated_intrinsics.is_refined(FOCAL)[representatives][:, None]
    while True:
        problem = replace(problem, variable_intrinsics=active)
        result = adjust_bundle(problem, options)
        refused = _decide(scene, result, images, representatives, problem, min_deviation)
        free &= ~refused
        free[:, 1:] &= free[:, :1]
        if refused.any():
            problem = _reset_intrinsics(scene, problem, images, representatives, estimated & ~free)
            active = active & free
        elif (free & ~active).any():
            problem = start_at(problem, result)
            active = free.copy()
        else:
            break
    for row in map(int, np.flatnonzero(active[:, FOCAL])):
        image = int(representatives[row])
        scene.set_shared_intrinsics(image, result.intrinsics[row], result.distortion[row])
    return result


def compute_intrinsic_priors(images: Sequence[MappingImage]) -> tuple[Float64, Float64]:
    """Compute means and standard deviations (k, 8) of the priors on intrinsic parameters."""
    means = intrinsic_parameters(np.array([image.camera.params for image in images]), None)
    means[:, FOCAL] = np.log([image.focal_prior_px for image in images])
    stds = np.full(means.shape, DISTORTION_PRIOR_STD)
    for row, image in enumerate(images):
        center_std = PRINCIPAL_POINT_PRIOR_STD * max(image.camera.size)
        stds[row, :4] = image.focal_log_std, ASPECT_PRIOR_STD, center_std, center_std
        if not image.camera_model.is_fisheye:
            stds[row, 6:] = TANGENTIAL_PRIOR_STD
            radius = 0.5 * float(np.hypot(*image.camera.size)) / image.camera.fx
            radial_std = max(DISTORTION_PRIOR_STD, CORNER_SHIFT_PRIOR_STD / radius**2)
            stds[row, IntrinsicParameter.RADIAL_DISTORTION] = radial_std
    return means, stds


def _reset_intrinsics(
    scene: Scene,
    problem: BundleProblem,
    images: Sequence[MappingImage],
    representatives: Int64,
    refused: Bool,
) -> BundleProblem:
    """Reset principal points and distortion to the scene, and refused parameters to their guess.

    Focal lengths keep the value of the problem.
    """
    intrinsics = problem.intrinsics.copy()
    for row, image in enumerate(images):
        fx, fy, *center = image.camera.params
        if refused[row, IntrinsicParameter.ASPECT_RATIO]:
            intrinsics[row, 1] = intrinsics[row, 0] * fy / fx
        current = scene.intrinsics[representatives[row], 2:]
        intrinsics[row, 2:] = np.where(refused[row, CENTER], center, current)
    distortion = np.where(
        refused[:, IntrinsicParameter.RADIAL_DISTORTION :],
        [image.initial_distortion or image.distortion for image in images],
        scene.distortion[representatives],
    )
    return replace(problem, intrinsics=intrinsics, distortion=distortion)


def _decide(
    scene: Scene,
    result: BundleResult,
    images: Sequence[MappingImage],
    representatives: Int64,
    problem: BundleProblem,
    min_deviation: float,
) -> Bool:
    """Record the outcome of each variable intrinsic parameter, and return those refused.

    If the focal length of a camera is refused, only the other parameters of the camera are fixed at
    first, because the focal length may be determined without them. If only other parameters are
    refused, the last one is fixed first, because the others may be determined without it.

    Returns:
        Mask (k, 8) of the refused intrinsic parameters.
    """
    variable, means = problem.variable_intrinsics, problem.prior_intrinsics
    assert variable is not None and means is not None
    values = intrinsic_parameters(result.intrinsics, result.distortion)
    stds = np.asarray(problem.prior_std_intrinsics)
    num_images = np.bincount(problem.camera_of_image, minlength=len(images))
    refused = np.zeros_like(variable)
    for row in map(int, np.flatnonzero(variable[:, FOCAL])):
        sharing = scene.shares_camera(int(representatives[row]))
        for column in map(int, np.flatnonzero(variable[row])):
            parameter, value = IntrinsicParameter(column), float(values[row, column])
            std, deviation = float(result.std_intrinsics[row, column]), value - means[row, column]
            has_few_images = parameter != FOCAL and num_images[row] < MIN_FOCAL_IMAGES
            is_small = has_few_images and abs(deviation) < min_deviation * std
            if parameter == FOCAL:
                value = float(result.intrinsics[row, 0])
                size = images[row].camera.size
                is_plausible = is_plausible_equivalent(compute_equivalent_mm(value, *size))
            else:
                is_plausible = bool(abs(deviation) <= MAX_PRIOR_DEVIATION * stds[row, column])
            estimate = judge_estimate(value, std, float(stds[row, column]), is_plausible)
            if is_small or (parameter != FOCAL and refused[row, FOCAL]):
                estimate = estimate._replace(outcome=CalibrationOutcome.NOT_OBSERVABLE)
            scene.estimated_intrinsics.set(sharing, parameter, estimate)
            refused[row, column] = estimate.outcome != CalibrationOutcome.REFINED
        others = np.flatnonzero(refused[row, 1:]) + 1
        if refused[row, FOCAL] and len(others):
            refused[row, FOCAL] = False
        elif len(others):
            refused[row, others[:-1]] = False
    return refused


def judge_estimate(
    value: float, posterior_std: float, prior_std: float, is_plausible: bool
) -> IntrinsicEstimate:
    """Decide whether a camera takes the estimate of an intrinsic parameter.

    Args:
        value: Estimated value.
        posterior_std: Posterior standard deviation of the parameter, given observations and prior.
            The computed value may exceed ``prior_std`` if the reduced camera system is singular.
        prior_std: Prior standard deviation.
        is_plausible: True if a lens with the estimated value exists.
    """
    std = min(posterior_std, prior_std)
    if not is_plausible:
        outcome = CalibrationOutcome.OUT_OF_RANGE
    elif not std <= MAX_STD_RATIO * prior_std:
        outcome = CalibrationOutcome.NOT_OBSERVABLE
    else:
        outcome = CalibrationOutcome.REFINED
    return IntrinsicEstimate(outcome, value, std)
