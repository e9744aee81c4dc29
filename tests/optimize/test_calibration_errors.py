"""Predicted calibration errors against the true errors of generated scenes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mpsfm_core.data import Float64
from mpsfm_core.geometry import angle_between_deg, camera_center, rotation_angle_deg
from mpsfm_core.optimize.bundle_adjustment import BundleProblem, adjust_bundle, start_at
from mpsfm_core.optimize.calibration_errors import (
    CalibrationErrors,
    predict_calibration_errors,
)
from mpsfm_core.optimize.options import BundleOptions
from mpsfm_core.testing.synthetic.scenes import look_at

FOCAL_PX, WIDTH, HEIGHT = 700.0, 640.0, 480.0
CENTER = np.array([WIDTH / 2, HEIGHT / 2])
NUM_IMAGES = 6
OPTIONS = BundleOptions(threads=1, function_tolerance=1e-9)
SIZES = np.array([[WIDTH, HEIGHT]])
UNKNOWN, KNOWN = np.array([False]), np.array([True])


def make_scene(
    seed: int,
    *,
    radial: float = 0.0,
    center_px: float = 0.0,
    zoom: float = 1.0,
    arc_deg: float = 40.0,
    noise_px: float = 0.4,
) -> BundleProblem:
    """Return images on an arc around a cloud of points, with true poses.

    Args:
        seed: Seed of poses, points and keypoint noise.
        radial: Radial distortion of all images.
        center_px: Distance of the principal point from the image center.
        zoom: Ratio of the focal lengths of the first image and of the others.
        arc_deg: Angle between the first and last viewing direction.
        noise_px: Standard deviation of the keypoint positions. A keypoint in 30 has ten times this
            noise.
    """
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(300, 3)) * (2.0, 1.5, 1.5)
    poses, images, rows, keypoints = [], [], [], []
    for image, angle in enumerate(np.radians(np.linspace(-arc_deg / 2, arc_deg / 2, NUM_IMAGES))):
        eye = 8 * np.array([np.sin(angle), 0.0, -np.cos(angle)]) + rng.normal(size=3) * 0.5
        pose = look_at(eye, rng.normal(size=3) * 0.3)
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        factor = FOCAL_PX * (1.0 if image else zoom)
        xy = factor * slopes * (1 + radial * (slopes**2).sum(axis=1, keepdims=True))
        xy += CENTER + center_px
        inside = (xy > 0).all(axis=1) & (xy < (WIDTH, HEIGHT)).all(axis=1)
        seen = np.flatnonzero(inside & (rng.random(len(points)) < 0.7))
        std = noise_px * np.where(rng.random(len(seen)) < 1 / 30, 10, 1)
        poses.append(pose)
        images.append(np.full(len(seen), image))
        rows.append(seen)
        keypoints.append(xy[seen] + rng.normal(size=(len(seen), 2)) * std[:, None])
    observed = np.concatenate(rows)
    shared = np.bincount(observed, minlength=len(points))[observed] >= 2
    used, observed = np.unique(observed[shared], return_inverse=True)
    return BundleProblem(
        rotations=np.array(poses)[:, :, :3],
        translations=np.array(poses)[:, :, 3],
        intrinsics=np.array([[FOCAL_PX, FOCAL_PX, *CENTER]]),
        distortion=np.zeros((1, 4)),
        camera_of_image=np.zeros(NUM_IMAGES, dtype=np.int64),
        points=points[used],
        obs_image=np.concatenate(images)[shared],
        obs_point=observed,
        obs_xy=np.concatenate(keypoints)[shared],
        obs_std_px=np.ones(len(observed)),
        variable_pose=np.arange(NUM_IMAGES) > 0,
        scale_anchor=NUM_IMAGES - 1,
        variable_intrinsics=np.arange(8)[None] == 0,
        prior_intrinsics=np.array([[np.log(FOCAL_PX), 0.0, *CENTER, 0.0, 0.0, 0.0, 0.0]]),
        prior_std_intrinsics=0.7,
    )


def solve(scene: BundleProblem) -> tuple[BundleProblem, CalibrationErrors]:
    """Adjust poses, points and the focal length, and predict their errors."""
    solved = start_at(scene, adjust_bundle(scene, OPTIONS))
    errors = predict_calibration_errors(solved, OPTIONS, UNKNOWN, SIZES)
    assert errors is not None
    return solved, errors


def measure_pose_errors_deg(solved: BundleProblem, true: BundleProblem) -> Float64:
    """Return the median relative pose error of each image."""
    errors = np.full((NUM_IMAGES, NUM_IMAGES), np.nan)
    for a, b in zip(*np.nonzero(~np.eye(NUM_IMAGES, dtype=np.bool_)), strict=True):
        relative = []
        for problem in (solved, true):
            center_a, center_b = (
                camera_center(problem.rotations[i], problem.translations[i]) for i in (a, b)
            )
            rotation = problem.rotations[a]
            relative.append((problem.rotations[b] @ rotation.T, rotation @ (center_b - center_a)))
        turn = rotation_angle_deg(relative[0][0] @ relative[1][0].T)
        errors[a, b] = max(turn, angle_between_deg(relative[0][1], relative[1][1]))
    return np.asarray(np.nanmedian(errors, axis=1))


@cache
def focal_errors(num_scenes: int, **changes: float) -> tuple[Float64, Float64, Float64]:
    """Return true log focal errors, predicted errors and stated std (s,) of several scenes."""
    true, predicted, stated = [], [], []
    for seed in range(num_scenes):
        scene = make_scene(seed, **changes)
        result = adjust_bundle(scene, OPTIONS)
        errors = predict_calibration_errors(start_at(scene, result), OPTIONS, UNKNOWN, SIZES)
        assert errors is not None
        true.append(np.log(result.intrinsics[0, 0] / FOCAL_PX))
        predicted.append(errors.log_focal[0])
        stated.append(result.std_intrinsics[0, 0])
    return np.array(true), np.array(predicted), np.array(stated)


@pytest.mark.parametrize(
    "changes",
    [{}, {"noise_px": 0.1}, {"radial": -0.1}, {"radial": -0.02}, {"center_px": 10.0}],
    ids=["right model", "little noise", "strong distortion", "weak distortion", "center"],
)
def test_predict_calibration_errors_of_focal_length_matches_true_errors(
    changes: dict[str, float],
) -> None:
    true, predicted, _ = focal_errors(8, **changes)
    normalized = np.sqrt((true**2 / predicted**2).mean())
    assert 0.15 < normalized < 1.7


def test_predict_calibration_errors_far_from_the_minimum_match_large_focal_errors() -> None:
    true, predicted, _ = focal_errors(3, radial=-0.5)
    assert (true > 0.1).all()
    np.testing.assert_allclose(predicted, true, rtol=0.1)


def test_predict_calibration_errors_with_overestimated_noise_are_below_the_stated_std() -> None:
    _, predicted, stated = focal_errors(8, noise_px=0.1)
    assert (predicted < 0.6 * stated).all()


@pytest.mark.parametrize("zoom", [0.9, 0.97])
@pytest.mark.parametrize("arc_deg", [40.0, 15.0])
def test_predict_calibration_errors_of_a_zoomed_image_matches_its_pose_error(
    zoom: float, arc_deg: float
) -> None:
    scene = make_scene(1, zoom=zoom, arc_deg=arc_deg)
    solved, errors = solve(scene)
    true = measure_pose_errors_deg(solved, scene)
    assert true[0] > 2
    assert errors.pose_deg[0] == pytest.approx(true[0], rel=0.4)
    assert errors.pose_deg[1:].max() < 0.5 * true[0]


def test_predict_calibration_errors_of_a_shifted_center_matches_the_pose_errors() -> None:
    scene = make_scene(0, center_px=30.0)
    solved, errors = solve(scene)
    true = measure_pose_errors_deg(solved, scene)
    assert true.max() > 2
    np.testing.assert_allclose(errors.pose_deg, true, rtol=0.5)


def test_predict_calibration_errors_of_a_right_camera_are_small() -> None:
    for arc_deg in (15.0, 40.0):
        assert solve(make_scene(0, arc_deg=arc_deg))[1].pose_deg.max() < 1


def test_predict_calibration_errors_of_a_known_camera_come_from_noise_only() -> None:
    scene = replace(make_scene(0, center_px=30.0), variable_intrinsics=None)
    solved = start_at(scene, adjust_bundle(scene, OPTIONS))
    errors = predict_calibration_errors(solved, OPTIONS, KNOWN, SIZES)
    assert errors is not None
    assert errors.log_focal[0] == errors.radial[0] == 0
    assert errors.pose_deg.max() < 0.5


def test_predict_calibration_errors_of_an_image_with_noisy_keypoints_match_its_pose_error() -> None:
    true_deg, predicted_deg = [], []
    for seed in range(8):
        scene = make_scene(seed)
        noise = 3.0 * np.random.default_rng(seed).normal(size=scene.obs_xy.shape)
        noise[np.asarray(scene.obs_image) != 2] = 0.0
        known = replace(scene, variable_intrinsics=None, obs_xy=scene.obs_xy + noise)
        solved = start_at(known, adjust_bundle(known, OPTIONS))
        errors = predict_calibration_errors(solved, OPTIONS, KNOWN, SIZES)
        assert errors is not None
        true_deg.append(measure_pose_errors_deg(solved, scene))
        predicted_deg.append(errors.pose_deg)
    true, predicted = np.array(true_deg), np.array(predicted_deg)
    assert np.sqrt((true[:, 2] ** 2).mean()) > 2 * np.sqrt((true[:, [0, 1, 4]] ** 2).mean())
    ratio = np.sqrt((true[:, 2] ** 2).mean()) / predicted[:, 2].mean()
    assert 0.6 < ratio < 3.0


def test_predict_calibration_errors_of_a_pure_rotation_are_large() -> None:
    scene = make_scene(0)
    point = camera_center(scene.rotations[0], scene.translations[0])
    one_center = replace(scene, translations=-scene.rotations @ (point + 1e-6))
    errors = predict_calibration_errors(one_center, OPTIONS, UNKNOWN, SIZES)
    assert errors is not None
    assert (errors.pose_deg > 20).all()


def test_predict_calibration_errors_without_a_variable_pose_returns_none() -> None:
    scene = replace(make_scene(0), variable_pose=np.zeros(NUM_IMAGES, dtype=np.bool_))
    assert predict_calibration_errors(scene, OPTIONS, UNKNOWN, SIZES) is None


def test_predict_calibration_errors_of_a_weak_unedited_image_are_small() -> None:
    scene = make_scene(0, noise_px=0.1)
    # The first image observes points in a plane, which leaves its focal length undetermined.
    pose_of_first = scene.rotations[0], scene.translations[0]
    depth = (scene.points @ pose_of_first[0].T + pose_of_first[1])[:, 2]
    in_plane = np.abs(depth - np.median(depth)) < 0.3
    chosen = (scene.obs_image > 0) | in_plane[scene.obs_point]
    weak = replace(
        scene,
        obs_image=scene.obs_image[chosen],
        obs_point=scene.obs_point[chosen],
        obs_xy=scene.obs_xy[chosen],
        obs_std_px=np.ones(int(chosen.sum())),
    )
    solved, errors = solve(weak)
    assert measure_pose_errors_deg(solved, weak)[0] < 0.5
    assert errors.pose_deg[0] < 1


def make_chain(seed: int, smooth_std: float) -> BundleProblem:
    """Return images in a row that share points with one or two neighbors, with true poses.

    Args:
        seed: Seed of poses, points, keypoint noise and depth errors.
        smooth_std: Standard deviation of the slope of a depth map from the center to the border.
    """
    rng = np.random.default_rng(seed)
    images, rows, keypoints, depths = [], [], [], []
    points = rng.uniform((-5, -4, 6), (7 * NUM_IMAGES - 2, 4, 7.5), (150 * NUM_IMAGES, 3))
    rotations = np.broadcast_to(np.eye(3), (NUM_IMAGES, 3, 3))
    centers = np.array([[7.0 * i, 0.0, 0.0] for i in range(NUM_IMAGES)])
    centers[::2] += (0.0, 1.0, -1.5)
    for image, center in enumerate(centers):
        in_camera = points - center
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        xy = FOCAL_PX / 2 * slopes + CENTER
        seen = np.flatnonzero(((xy > 0) & (xy < (WIDTH, HEIGHT))).all(axis=1))
        slope = smooth_std * rng.normal(size=2)
        depths.append(np.log(in_camera[seen, 2]) + (xy[seen] / CENTER - 1) @ slope)
        images.append(np.full(len(seen), image))
        rows.append(seen)
        keypoints.append(xy[seen] + rng.normal(size=(len(seen), 2)) * 0.4)
    observed = np.concatenate(rows)
    shared = np.bincount(observed, minlength=len(points))[observed] == 2
    used, observed = np.unique(observed[shared], return_inverse=True)
    return BundleProblem(
        rotations=rotations,
        translations=-centers,
        intrinsics=np.array([[FOCAL_PX / 2, FOCAL_PX / 2, *CENTER]]),
        camera_of_image=np.zeros(NUM_IMAGES, dtype=np.int64),
        points=points[used],
        obs_image=np.concatenate(images)[shared],
        obs_point=observed,
        obs_xy=np.concatenate(keypoints)[shared],
        obs_std_px=0.4,
        obs_log_depth=np.concatenate(depths)[shared],
        obs_std_log_depth=0.1,
        variable_pose=np.arange(NUM_IMAGES) > 0,
        variable_scale=np.arange(NUM_IMAGES) > 0,
        std_log_scales=0.2,
    )


def test_predict_calibration_errors_of_a_chain_contains_smooth_depth_errors() -> None:
    ratios: dict[float, list[float]] = {0.0: [], 1.0: []}
    for seed in range(8):
        scene = make_chain(seed, 0.1)
        solved = start_at(scene, adjust_bundle(scene, OPTIONS))
        true = measure_pose_errors_deg(solved, scene)
        for ratio, values in ratios.items():
            errors = predict_calibration_errors(solved, OPTIONS, KNOWN, SIZES, ratio)
            assert errors is not None
            values.append(float(np.sqrt((true**2 / errors.pose_deg**2).mean())))
    assert np.mean(ratios[0.0]) > 2
    assert 0.3 < np.mean(ratios[1.0]) < 1.5
