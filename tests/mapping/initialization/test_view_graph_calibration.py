"""Tests that relative poses of image pairs determine guessed focal length and distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.mapping.initialization.view_graph_calibration import (
    MAX_PAIRS,
    calibrate_view_graph,
    estimate_shared_lens,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import room_scene
from tests.mapping.focal_scenes import CAMERA, POSES, distort, scale_focal


def make_problem(distance_changes: Sequence[float], burst_size: int = 0) -> MappingProblem:
    """Return images of an orbit around a room, with changes of the distances to the center.

    Additional images of a burst are 1 mm apart, close to the first image.
    """
    poses = [pose.copy() for pose in POSES]
    for pose, change in zip(poses, distance_changes, strict=True):
        pose[2, 3] += change
    for number in range(1, burst_size + 1):
        poses.append(poses[0].copy())
        poses[-1][0, 3] += 1e-3 * number
    noise = SyntheticNoise(keypoints_px=0.5)
    return make_mapping_problem(
        room_scene(), CAMERA, poses, points_per_view=60, map_width=40, noise=noise
    )


def guess_focal(problem: MappingProblem, ratio: float) -> MappingProblem:
    """Return the problem with a guessed focal length of ``ratio`` times the true one."""
    camera = scale_focal(CAMERA, ratio)
    images = tuple(replace(i, camera=camera, focal_known=False) for i in problem.images)
    return replace(problem, images=images)


@pytest.fixture(scope="module")
def room() -> MappingProblem:
    return make_problem([0.0, 0.3, -0.3, 0.4, -0.2])


@pytest.mark.parametrize(("ratio", "k1"), [(1.6, 0.0), (0.6, 0.0), (1.6, -0.15)])
def test_estimate_shared_lens_finds_the_focal_length_of_distorted_images(
    room: MappingProblem, ratio: float, k1: float
) -> None:
    problem = guess_focal(distort(room, k1), ratio)
    lens = estimate_shared_lens(problem, problem.pairs)
    assert lens.focal_px == pytest.approx(CAMERA.fx, rel=0.04)
    assert lens.k1 == pytest.approx(k1, abs=0.03)


def test_estimate_shared_lens_of_a_burst_and_an_orbit_uses_pairs_with_motion() -> None:
    problem = guess_focal(make_problem([0.0, 0.3, -0.3, 0.4, -0.2], burst_size=11), 1.6)
    is_burst = [{pair.image_a, pair.image_b} <= {0, *range(5, 16)} for pair in problem.pairs]
    num_matches = [len(pair.matches) for pair in problem.pairs]
    most = np.argsort(num_matches)[-MAX_PAIRS:]
    assert np.array(is_burst)[most].all()
    lens = estimate_shared_lens(problem, problem.pairs)
    assert lens == (pytest.approx(CAMERA.fx, rel=0.04), 0.0)


def test_estimate_shared_lens_excludes_zoomed_images(room: MappingProblem) -> None:
    center = np.array([CAMERA.cx, CAMERA.cy])
    images = list(guess_focal(room, 1.6).images)
    for row, zoom in ((1, 1.5), (3, 0.9)):
        xy = zoom * (images[row].keypoints - center) + center
        images[row] = replace(images[row], keypoints=xy)
    problem = replace(room, images=tuple(images))
    lens = estimate_shared_lens(problem, problem.pairs, refine_distortion=False)
    assert lens == (pytest.approx(CAMERA.fx, rel=0.1), 0.0)


def test_calibrate_view_graph_keeps_the_prior_and_updates_relative_poses(
    room: MappingProblem,
) -> None:
    problem = guess_focal(room, 1.6)
    calibrated = calibrate_view_graph(problem, seed=0)
    for image in calibrated.images:
        assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.04)
        assert image.focal_prior_px == pytest.approx(1.6 * CAMERA.fx)
    for true, pair in zip(room.pairs, calibrated.pairs, strict=True):
        np.testing.assert_allclose(pair.rotation, true.rotation, atol=0.02)


def test_calibrate_view_graph_undistorts_keypoints_before_relative_poses(
    room: MappingProblem,
) -> None:
    problem = guess_focal(distort(room, -0.15), 1.0)
    calibrated = calibrate_view_graph(problem, seed=0)
    for image, given in zip(calibrated.images, problem.images, strict=True):
        assert image.camera == CAMERA
        assert image.initial_distortion == (pytest.approx(-0.15, abs=0.03), 0.0, 0.0, 0.0)
        np.testing.assert_array_equal(image.keypoints, given.keypoints)
    for true, pair in zip(room.pairs, calibrated.pairs, strict=True):
        np.testing.assert_allclose(pair.rotation, true.rotation, atol=0.02)
    scene = Scene(calibrated)
    undistorted = np.concatenate([image.keypoints for image in room.images])
    assert np.linalg.norm(scene.keypoints - undistorted, axis=1).max() < 5
    distorted = np.concatenate([image.keypoints for image in problem.images])
    np.testing.assert_array_equal(scene.distorted_keypoints, distorted)


@pytest.mark.parametrize("ratio", [1.0, 1.05])
def test_calibrate_view_graph_keeps_guesses_that_are_nearly_right(
    room: MappingProblem, ratio: float
) -> None:
    problem = guess_focal(room, ratio)
    assert calibrate_view_graph(problem, seed=0) is problem


def test_calibrate_view_graph_keeps_cameras_without_pairs_of_their_own(
    room: MappingProblem,
) -> None:
    images = guess_focal(room, 1.6).images
    own = tuple(replace(image, camera_id=row) for row, image in enumerate(images))
    fisheye = tuple(replace(i, camera_model=CameraModel.OPENCV_FISHEYE) for i in images)
    for problem in (room, replace(room, images=own), replace(room, images=fisheye)):
        assert calibrate_view_graph(problem, seed=0) is problem


@pytest.mark.parametrize("shift", [(0, 0), (10, -6)])
def test_estimate_shared_lens_of_an_orbit_at_constant_distance_keeps_the_guess(
    shift: tuple[int, int],
) -> None:
    problem = guess_focal(make_problem([0.0] * 5), 1.6)
    images = tuple(replace(i, keypoints=i.keypoints + shift) for i in problem.images)
    problem = replace(problem, images=images)
    assert estimate_shared_lens(problem, problem.pairs).focal_px == 1.6 * CAMERA.fx
