"""Self-calibration, which accepts or refuses intrinsics that bundle adjustment estimates.

Bundle adjustment estimates log focal lengths with a normal prior, whose standard deviation depends
on the source of the guess (EXIF, a network, or a default). A camera takes the estimated focal
length if the observations determine the focal length better than the prior, and if a lens of this
focal length exists. Guessed focal lengths that a camera keeps are fixed, and the remaining focal
lengths are estimated again. The radial distortion of a camera with a refined focal length also
takes an estimate that is well determined and plausible.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingImage
from mpsfm_core.geometry.focal_length import compute_equivalent_mm, is_plausible_equivalent
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    MIN_FOCAL_IMAGES,
    CalibrationOutcome,
    IntrinsicEstimate,
    IntrinsicParameter,
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
RADIAL_PRIOR_STD = 0.1
"""Standard deviation of the zero-mean prior on the radial distortion. The radial distortion of
phones and zoom lenses stays below 0.05 in magnitude, that of action cameras below 0.3. [ours]"""
MAX_RADIAL = 0.6
"""Largest plausible magnitude of the radial distortion, because SIMPLE_RADIAL does not describe
stronger distortion. [ours]"""


def has_guessed_camera(scene: Scene, images: Int64) -> Bool:
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
) -> BundleResult:
    """Run bundle adjustment with guessed intrinsics, and apply well-determined estimates.

    The radial distortion of a camera becomes variable after its focal length is refined, because
    radial distortion would otherwise compensate a wrong focal length. A camera of fewer than
    ``MIN_FOCAL_IMAGES`` images keeps its radial distortion, because systematic errors of few images
    resemble distortion. An intrinsic parameter whose estimate is implausible or undetermined keeps
    the guess, and bundle adjustment is repeated with this parameter fixed. The outcome of each
    camera is recorded in the scene.

    Args:
        scene: The scene, which receives the refined intrinsics.
        problem: The bundle adjustment problem with constant intrinsics.
        options: Options of bundle adjustment.
        representatives: (k,) index of one image of each camera of the problem.
        refine_distortion: Refine radial distortions in addition to focal lengths.
    """
    images = [scene.problem.images[image] for image in representatives]
    guessed_radials = np.array([image.radial for image in images])
    focal = has_guessed_camera(scene, representatives)
    num_images = np.bincount(problem.camera_of_image, minlength=len(images))
    may_distort = focal & refine_distortion & (num_images >= MIN_FOCAL_IMAGES)
    is_refined = scene.estimated_intrinsics.is_refined(IntrinsicParameter.FOCAL_LENGTH)
    radial = may_distort & is_refined[representatives]
    problem = replace(
        problem,
        prior_log_focals=np.log([image.focal_prior_px for image in images]),
        prior_std_log_focals=np.array([image.focal_log_std for image in images]),
        prior_std_radial=RADIAL_PRIOR_STD,
    )
    while True:
        problem = replace(problem, variable_focal=focal, variable_radial=radial)
        result = adjust_bundle(problem, options)
        refuses_focal, refuses_radial = _decide(scene, result, images, representatives, problem)
        may_distort &= ~refuses_radial & (focal & ~refuses_focal)
        if refuses_focal.any() or refuses_radial.any():
            radials = np.where(may_distort, scene.radial[representatives], guessed_radials)
            problem = replace(problem, radial=radials)
            focal, radial = focal & ~refuses_focal, radial & may_distort
        elif (may_distort & ~radial).any():
            problem = start_at(problem, result)
            radial = may_distort
        else:
            break
    for row, image in enumerate(map(int, representatives)):
        if focal[row]:
            scene.set_shared_intrinsics(image, result.intrinsics[row, :2], result.radial[row])
    return result


def _decide(
    scene: Scene,
    result: BundleResult,
    images: list[MappingImage],
    representatives: Int64,
    problem: BundleProblem,
) -> tuple[Bool, Bool]:
    """Record the outcome of each variable intrinsic parameter, and return those refused.

    If the focal length of a camera with variable radial distortion is refused, only the radial
    distortion is fixed at first, because the focal length may be determined without distortion.

    Returns:
        Masks (k,) of the cameras whose focal length, and whose radial distortion is refused.
    """
    assert problem.variable_focal is not None and problem.variable_radial is not None
    refuses_focal, refuses_radial = np.zeros((2, len(images)), dtype=np.bool_)
    for row in map(int, np.flatnonzero(problem.variable_focal)):
        image, focal_px = images[row], float(result.intrinsics[row, 0])
        sharing = scene.shares_camera(int(representatives[row]))
        focal = judge_estimate(
            focal_px,
            float(result.std_log_focals[row]),
            image.focal_log_std,
            is_plausible_equivalent(compute_equivalent_mm(focal_px, *image.camera.size)),
        )
        scene.estimated_intrinsics.set(sharing, IntrinsicParameter.FOCAL_LENGTH, focal)
        refuses_focal[row] = focal.outcome != CalibrationOutcome.REFINED
        if problem.variable_radial[row]:
            value = float(result.radial[row])
            std = float(result.std_radial[row])
            radial = judge_estimate(value, std, RADIAL_PRIOR_STD, abs(value) <= MAX_RADIAL)
            if refuses_focal[row]:
                radial = radial._replace(outcome=CalibrationOutcome.NOT_OBSERVABLE)
            scene.estimated_intrinsics.set(sharing, IntrinsicParameter.RADIAL_DISTORTION, radial)
            refuses_radial[row] = radial.outcome != CalibrationOutcome.REFINED
            refuses_focal[row] = False
    return refuses_focal, refuses_radial


def judge_estimate(
    value: float, posterior_std: float, prior_std: float, is_plausible: bool
) -> IntrinsicEstimate:
    """Decide whether a camera takes the estimate of an intrinsic parameter.

    Args:
        value: Estimated value.
        posterior_std: Posterior standard deviation of the parameter, given observations and prior.
            If the reduced camera system is singular, the computed value may exceed its upper bound
            ``prior_std``.
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
