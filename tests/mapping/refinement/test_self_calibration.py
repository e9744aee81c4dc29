"""Tests of self-calibration: estimated focal lengths are refined for each camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.camera_models import CameraModel, IntrinsicParameter
from mpsfm_core.data.decisions import CameraReason
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.distortion import distort_rays, undistort_rays
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.self_calibration import (
    compute_intrinsic_priors,
    judge_estimate,
)
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.estimated_intrinsics import CalibrationOutcome
from mpsfm_core.mapping.scene.reconstruction import VIEW_PARAMETERS
from tests.mapping.focal_scenes import (
    CAMERA,
    POSES,
    distort,
    guess_focals,
    make_room,
    register_true_poses,
    scale_focal,
)

FOCAL = IntrinsicParameter.FOCAL_LENGTH
REMOVED = (-0.08, 0.0, 0.0, 0.0)
"""Distortion coefficients that were removed from views before mapping."""
RADIAL = IntrinsicParameter.RADIAL_DISTORTION


@pytest.fixture(scope="module")
def room() -> MappingProblem:
    return make_room()


@pytest.mark.parametrize(
    "factors",
    [(1.6,) * 5, (0.55,) * 5, (2.5,) * 5, (1.7, 0.6, 1.3, 0.8, 1.01)],
    ids=["shared long", "shared short", "shared very long", "one camera per image"],
)
def test_reconstruct_with_wrong_focal_lengths_refines_all(
    room: MappingProblem, factors: Sequence[float]
) -> None:
    model = reconstruct(guess_focals(room, factors)).reconstructions[0]
    assert len(model.images) == 5
    for image in model.images:
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
        focal_std = image.calibration[FOCAL].std
        assert focal_std is not None and 0 < focal_std < 0.01
        assert image.calibration[FOCAL].is_refined
        assert image.pose_error_deg is not None and 0 < image.pose_error_deg < 1
        for other in model.images:
            relative = image.rotation @ other.rotation.T
            true_relative = POSES[image.index][:, :3] @ POSES[other.index][:, :3].T
            assert rotation_angle_deg(relative @ true_relative.T) < 0.5


@pytest.mark.parametrize(("radial", "factor"), [(-0.25, 1.2), (-0.1, 0.8), (0.05, 1.6)])
def test_reconstruct_with_radial_distortion_refines_shared_camera(
    room: MappingProblem, radial: float, factor: float
) -> None:
    problem = guess_focals(distort(room, radial), [factor] * 5)
    model = reconstruct(problem).reconstructions[0]
    assert len(model.images) == 5
    for image in model.images:
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
        assert image.distortion[0] == pytest.approx(radial, abs=0.01)
        radial_std = image.calibration[RADIAL].std
        assert radial_std is not None and 0 < radial_std < 0.01
        assert image.calibration[RADIAL].is_refined
        relative = image.rotation @ model.images[0].rotation.T
        true_relative = POSES[image.index][:, :3] @ POSES[0][:, :3].T
        assert rotation_angle_deg(relative @ true_relative.T) < 0.3


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        (CameraModel.RADIAL, (-0.2, 0.08)),
        (CameraModel.OPENCV, (-0.1, 0.03, 0.004, -0.006)),
        (CameraModel.OPENCV_FISHEYE, (0.05, -0.03)),
    ],
)
def test_reconstruct_with_camera_model_refines_its_parameters(
    room: MappingProblem, model: CameraModel, coefficients: tuple[float, ...]
) -> None:
    problem = guess_focals(distort(room, *coefficients, model=model), [1.1] * 5)
    if model.is_fisheye:
        problem = undistort_equidistantly(problem)
    options = MapperOptions.model_validate({"max_runs": 1})
    reconstruction = reconstruct(problem, options).reconstructions[0]
    assert len(reconstruction.images) == 5
    grid = np.mgrid[-0.5:0.6:0.1, -0.4:0.5:0.1].reshape(2, -1).T
    padded = [*coefficients, 0.0, 0.0, 0.0, 0.0][:4]
    expected = CAMERA.fx * distort_rays(grid, padded, fisheye=model.is_fisheye)
    for image in reconstruction.images:
        assert image.camera_model == model
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
        refined = distort_rays(grid, image.distortion.tolist(), fisheye=model.is_fisheye)
        error_px = image.camera.params[:2] * refined - expected
        assert np.abs(error_px).mean() < 1.5
        k1 = image.calibration[RADIAL]
        assert k1.is_refined and k1.std is not None and 0 < k1.std < 0.05


def undistort_equidistantly(problem: MappingProblem) -> MappingProblem:
    """Return the problem with keypoints undistorted by fisheye cameras without coefficients."""
    images = []
    for image in problem.images:
        focal, center = image.camera.params[:2], image.camera.params[2:]
        rays = undistort_rays((image.keypoints - center) / focal, [0.0] * 4, fisheye=True)
        images.append(replace(image, keypoints=center + focal * rays))
    return replace(problem, images=tuple(images))


def test_reconstruct_with_principal_point_refines_it() -> None:
    room = make_room(replace(CAMERA, cx=CAMERA.cx + 9, cy=CAMERA.cy - 6))
    images = tuple(replace(image, camera=CAMERA) for image in room.images)
    problem = guess_focals(replace(room, images=images), [1.05] * 5)
    options = MapperOptions.model_validate(
        {"max_runs": 1, "refinement": {"refine_principal_point": True}}
    )
    for image in reconstruct(problem, options).reconstructions[0].images:
        errors = image.camera.params[2:] - room.images[0].camera.params[2:]
        for parameter, error in zip(VIEW_PARAMETERS[1:], errors, strict=True):
            std = image.calibration[parameter].std
            assert std is not None and abs(error) < 3 * std
        assert np.abs(errors).max() < 2.0
        assert image.changes_view


def test_metric_depth_of_a_guessed_focal_length_gives_meters_with_the_refined_one(
    room: MappingProblem,
) -> None:
    """The network predicts depth that is proportional to the guessed focal length."""
    factor = 1.6
    guessed = guess_focals(room, [factor] * 5)
    images = []
    for image in guessed.images:
        variance = image.depth.variance
        assert variance is not None
        depth = replace(
            image.depth,
            depth=image.depth.depth * np.float32(factor),
            variance=variance * np.float32(factor**2),
        )
        images.append(replace(image, depth=depth, depth_focal_px=image.camera.fx))
    problem = replace(guessed, images=tuple(images))
    model = reconstruct(problem).reconstructions[0]
    assert model.metric is not None and model.metric.trusted
    first, last = (camera_center(*model.poses[image.name]) for image in (images[0], images[-1]))
    truth = [camera_center(pose[:, :3], pose[:, 3]) for pose in (POSES[0], POSES[-1])]
    expected = np.linalg.norm(truth[0] - truth[1])
    assert np.linalg.norm(first - last) == pytest.approx(expected, rel=0.02)


def test_compute_intrinsic_priors_allows_more_distortion_of_long_focal_lengths(
    room: MappingProblem,
) -> None:
    images = [replace(room.images[0], camera=scale_focal(CAMERA, ratio)) for ratio in (1.0, 4.0)]
    _, stds = compute_intrinsic_priors(images)
    corner_radius = np.hypot(320, 240) / (4.0 * CAMERA.fx)
    assert stds[:, RADIAL] == pytest.approx([0.1, 0.025 / corner_radius**2])


def test_reconstruct_with_one_image_per_camera_refines_its_distortion(
    room: MappingProblem,
) -> None:
    clear, none = distort(room, -0.25), room
    images = [(none if i == 2 else clear).images[i] for i in range(5)]
    problem = guess_focals(replace(room, images=tuple(images)), [0.9, 0.95, 1.0, 1.05, 1.1])
    options = MapperOptions.model_validate({"max_runs": 1})
    for image in reconstruct(problem, options).reconstructions[0].images:
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
        assert image.calibration[RADIAL].is_refined
        expected = 0.0 if image.index == 2 else -0.25
        assert image.distortion[0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_adjust_with_wrong_tracks_of_two_images_takes_the_camera_of_long_tracks(
    room: MappingProblem, factor: float
) -> None:
    """The keypoints of each track of two images follow another lens."""
    component = register_true_poses(guess_focals(room, [factor] * 5))
    scene, tracks = component.scene, component.scene.tracks
    keypoints, points = tracks.observations_of(np.arange(0, len(tracks.xyz), 2))
    is_third = np.concatenate([[False, False], points[2:] == points[:-2]])
    tracks.remove_observations(keypoints[is_third])
    observations = tracks.observations()
    lengths = tracks.lengths()[tracks.point_of[observations]]
    wrong = observations[lengths == 2]
    assert 0.2 < len(wrong) / len(observations) < 0.8
    center = [CAMERA.cx, CAMERA.cy]
    rays = (scene.distorted_keypoints[wrong] - center) / CAMERA.fx
    scene.distorted_keypoints[wrong] = center + 0.95 * CAMERA.fx * distort_rays(
        rays, [-0.1, 0, 0, 0]
    )
    errors = []
    for component.refiner.calibrates_with_long_tracks in (False, True):
        component.refiner.adjust(list(range(5)), focal=True)
        errors.append(np.abs(scene.intrinsics[:, 0] / CAMERA.fx - 1).max())
    assert errors[0] > 2 * errors[1] and errors[1] < 0.01
    assert scene.distortion[:, 0] == pytest.approx(0.0, abs=0.01)


def test_reconstruct_of_partly_undistorted_views_refines_the_original_distortion(
    room: MappingProblem,
) -> None:
    """Views from which a coefficient of -0.08 was removed, although -0.1 is true."""
    distorted = guess_focals(distort(room, -0.1), [1.0] * 5)
    center = np.array([CAMERA.cx, CAMERA.cy])
    images = []
    for image in distorted.images:
        rays = undistort_rays((image.keypoints - center) / CAMERA.fx, REMOVED)
        images.append(replace(image, keypoints=center + CAMERA.fx * rays, distortion=REMOVED))
    for image in reconstruct(replace(distorted, images=tuple(images))).reconstructions[0].images:
        assert image.distortion[0] == pytest.approx(-0.1, abs=0.005)
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


def test_reconstruct_without_refinement_of_distortion_keeps_pinhole_cameras(
    room: MappingProblem,
) -> None:
    options = MapperOptions.model_validate(
        {"max_runs": 1, "refinement": {"refine_distortion": False}}
    )
    problem = guess_focals(distort(room, -0.05), [1.0] * 5)
    for image in reconstruct(problem, options).reconstructions[0].images:
        assert image.distortion[0] == 0 and image.calibration[RADIAL].std is None
        assert image.calibration[RADIAL].reason == CameraReason.DISTORTION_NOT_ESTIMATED.because()


def test_reconstruct_with_known_focal_lengths_keeps_them(room: MappingProblem) -> None:
    for image in reconstruct(room).reconstructions[0].images:
        assert image.camera == CAMERA
        assert image.calibration[FOCAL].reason == CameraReason.KNOWN.because()
        assert image.calibration[FOCAL].std is None
        assert image.distortion[0] == 0
        assert image.calibration[RADIAL].std is image.calibration[RADIAL].reason is None


def test_reconstruct_without_refinement_keeps_guesses(room: MappingProblem) -> None:
    options = MapperOptions.model_validate({"max_runs": 1, "refinement": {"refine_focal": False}})
    problem = guess_focals(room, [1.02] * 5)
    for image in reconstruct(problem, options).reconstructions[0].images:
        assert image.camera == problem.images[0].camera
        assert image.calibration[FOCAL].reason == CameraReason.NOT_ESTIMATED.because()


def test_convert_scene_of_two_images_gives_too_few_images(room: MappingProblem) -> None:
    scene = register_true_poses(guess_focals(room, [1.02] * 5), range(2)).scene
    reason = convert_scene(scene).images[0].calibration[FOCAL].reason
    assert reason == CameraReason.TOO_FEW_IMAGES.because(num_images=2, min_images=3)


def test_adjust_with_implausible_camera_refines_the_others(room: MappingProblem) -> None:
    """The view of one image is enlarged 40 times: no lens has its focal length."""
    last = room.images[4]
    center = np.array([CAMERA.cx, CAMERA.cy])
    enlarged = replace(
        last,
        keypoints=center + 40 * (last.keypoints - center),
        camera=scale_focal(CAMERA, 40),
        keypoint_std_px=40 * last.keypoint_std_px,
        focal_known=False,
    )
    guess = scale_focal(CAMERA, 1.02)
    images = [replace(image, camera=guess, focal_known=False) for image in room.images[:4]]
    component = register_true_poses(replace(room, images=(*images, enlarged)))
    component.refiner.adjust(list(range(5)), focal=True)
    scene = component.scene
    assert scene.intrinsics[4, 0] == enlarged.camera.fx
    outcomes = [scene.estimated_intrinsics.get(image, FOCAL).outcome for image in range(5)]
    assert outcomes == [CalibrationOutcome.REFINED] * 4 + [CalibrationOutcome.OUT_OF_RANGE]
    assert scene.intrinsics[:4, 0] == pytest.approx(CAMERA.fx, rel=0.005)
    reason = convert_scene(scene).images[4].calibration[FOCAL].reason
    assert reason is not None and reason.code == CameraReason.OUT_OF_RANGE
    assert reason.values["equivalent_mm"] == pytest.approx(40 * 520 / 800 * 43.27, rel=0.1)


def test_adjust_with_narrow_prior_keeps_the_guess(room: MappingProblem) -> None:
    component = register_true_poses(guess_focals(room, [1.02] * 5, log_std=1e-4))
    component.refiner.adjust(list(range(5)), focal=True)
    assert (component.scene.intrinsics[:, 0] == 1.02 * CAMERA.fx).all()
    for image in convert_scene(component.scene).images:
        assert image.calibration[FOCAL].reason is not None
        assert image.calibration[FOCAL].reason.code == CameraReason.NOT_OBSERVABLE


@pytest.mark.parametrize(
    ("is_plausible", "posterior_std", "prior_std", "expected"),
    [
        (False, 0.01, 0.7, CalibrationOutcome.OUT_OF_RANGE),
        (True, 0.4, 0.7, CalibrationOutcome.NOT_OBSERVABLE),
        (True, np.inf, 0.7, CalibrationOutcome.NOT_OBSERVABLE),
        (True, 0.04, 0.1, CalibrationOutcome.REFINED),
    ],
)
def test_judge_estimate_by_range_and_information(
    is_plausible: bool, posterior_std: float, prior_std: float, expected: CalibrationOutcome
) -> None:
    estimate = judge_estimate(28.0, posterior_std, prior_std, is_plausible)
    assert estimate == (expected, 28.0, min(posterior_std, prior_std))
