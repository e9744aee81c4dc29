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
from mpsfm_core.mapping.scene.calibration_outcome import MIN_FOCAL_IMAGES, CalibrationOutcome
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
    radial = may_distort & (scene.focal_outcome[representatives] == CalibrationOutcome.REFINED)
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
            scene.set_shared_focal(image, *map(float, result.intrinsics[row, :2]))
            scene.set_shared_radial(image, float(result.radial[row]))
    return result


def _decide(
    scene: Scene,
    result: BundleResult,
    images: list[MappingImage],
    representatives: Int64,
    problem: BundleProblem,
) -> tuple[Bool, Bool]:
    """Record the outcome of each variable intrinsic parameter, and return the refused ones.

    If the focal length of a camera with variable radial distortion is refused, only the radial
    distortion is fixed at first, because the focal length may be determined without distortion.

    Returns:
        Masks (k,) of the cameras whose focal length, and whose radial distortion is refused.
    """
    assert problem.variable_focal is not None and problem.variable_radial is not None
    refuses_focal, refuses_radial = np.zeros((2, len(images)), dtype=np.bool_)
    for row in map(int, np.flatnonzero(problem.variable_focal)):
        image, focal_px = images[row], float(result.intrinsics[row, 0])
        # the posterior variance is at most the prior variance, also if the reduced camera system is
        # singular
        std = min(float(result.std_log_focals[row]), image.focal_log_std)
        equivalent_mm = compute_equivalent_mm(focal_px, *image.camera.size)
        outcome = decide_focal_outcome(equivalent_mm, std, image.focal_log_std)
        scene.set_focal_outcome(int(representatives[row]), outcome, std, focal_px)
        refuses_focal[row] = outcome != CalibrationOutcome.REFINED
        if problem.variable_radial[row]:
            radial = float(result.radial[row])
            radial_std = min(float(result.std_radial[row]), RADIAL_PRIOR_STD)
            outcome = decide_radial_outcome(radial, radial_std)
            if refuses_focal[row]:
                outcome = CalibrationOutcome.NOT_OBSERVABLE
            scene.set_radial_outcome(int(representatives[row]), outcome, radial_std, radial)
            refuses_radial[row] = outcome != CalibrationOutcome.REFINED
            refuses_focal[row] = False
    return refuses_focal, refuses_radial


def decide_focal_outcome(
    equivalent_mm: float, posterior_std: float, prior_std: float
) -> CalibrationOutcome:
    """Decide whether a camera takes its estimated focal length.

    Args:
        equivalent_mm: Estimated focal length as 35 mm equivalent.
        posterior_std: Posterior standard deviation of the log focal length, given observations and
            prior.
        prior_std: Prior standard deviation of the log focal length.
    """
    if not is_plausible_equivalent(equivalent_mm):
        return CalibrationOutcome.OUT_OF_RANGE
    if not posterior_std <= MAX_STD_RATIO * prior_std:
        return CalibrationOutcome.NOT_OBSERVABLE
    return CalibrationOutcome.REFINED


def decide_radial_outcome(radial: float, posterior_std: float) -> CalibrationOutcome:
    """Decide whether a camera takes its estimated radial distortion.

    Args:
        radial: The estimated coefficient.
        posterior_std: Posterior standard deviation of the radial distortion coefficient.
    """
    if abs(radial) > MAX_RADIAL:
        return CalibrationOutcome.OUT_OF_RANGE
    if not posterior_std <= MAX_STD_RATIO * RADIAL_PRIOR_STD:
        return CalibrationOutcome.NOT_OBSERVABLE
    return CalibrationOutcome.REFINED
