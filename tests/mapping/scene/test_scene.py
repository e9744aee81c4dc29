"""Tests of the scene: projection of points, rollback of intrinsics, and checkpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.geometry import project
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    CalibrationOutcome,
    IntrinsicEstimate,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.mapping.focal_scenes import CAMERA, guess_focals, make_room

FIRST = np.array([1.0, 0.0, 0.0, 0.0])
"""Distortion coefficients with k1 = 1."""


def with_focal(focal_px: float) -> Float64:
    """Return the intrinsics of the test camera with another focal length."""
    return np.array([focal_px, focal_px * CAMERA.fy / CAMERA.fx, CAMERA.cx, CAMERA.cy])


def test_restore_undoes_focal_lengths_and_outcomes() -> None:
    scene = Scene(guess_focals(make_room(), [1.1] * 5))
    before = scene.snapshot()
    scene.set_shared_intrinsics(0, with_focal(400.0), np.zeros(4))
    estimate = IntrinsicEstimate(CalibrationOutcome.REFINED, 400.0, 0.02)
    focal_length = IntrinsicParameter.FOCAL_LENGTH
    scene.estimated_intrinsics.set(scene.shares_camera(0), focal_length, estimate)
    assert scene.estimated_intrinsics.get(4, focal_length) == estimate
    scene.restore(before)
    assert (scene.intrinsics[:, 0] == 1.1 * CAMERA.fx).all()
    for parameter in IntrinsicParameter:
        outcome, value, std = scene.estimated_intrinsics.get(4, parameter)
        assert outcome == CalibrationOutcome.NOT_ESTIMATED
        assert np.isnan([value, std]).all()


def test_resumed_images_keep_their_own_focal_lengths() -> None:
    """A mapper run may split a shared camera, if photos have different zooms."""
    problem = guess_focals(make_room(), [1.1] * 5)
    scene, resumed = Scene(problem), Scene(problem)
    for image, focal_px in enumerate((400.0, 400.0, 600.0, 400.0)):
        scene.register(image, np.eye(3), np.array([0.1 * image, 0.0, 0.0]))
        scene.maps[image].set_scale(1.0)
        scene.set_intrinsics(image, with_focal(focal_px), 1e-4 * focal_px * FIRST)
    resumed.resume(convert_scene(scene))
    np.testing.assert_array_equal(resumed.intrinsics[:, 0], [400.0, 400.0, 600.0, 400.0, 400.0])
    np.testing.assert_allclose(resumed.distortion[:, 0], [0.04, 0.04, 0.06, 0.04, 0.04])
    of_registered = scene.registered[scene.graph.image_of]
    np.testing.assert_array_equal(resumed.keypoints[of_registered], scene.keypoints[of_registered])


@pytest.mark.parametrize("radial", [0.0, 0.05])
@pytest.mark.parametrize("focal", [1.0, 1.2])
def test_scene_restored_from_checkpoint_has_identical_keypoints(
    radial: float, focal: float
) -> None:
    """The distortion of the first scene changed and was rolled back before the checkpoint."""
    problem = guess_focals(make_room(), [1.1] * 5)
    problem = replace(
        problem,
        images=tuple(replace(i, distortion=(radial, 0.0, 0.0, 0.0)) for i in problem.images),
    )
    scene, restored = Scene(problem), Scene(problem)
    scene.set_shared_intrinsics(0, with_focal(focal * CAMERA.fx), radial * FIRST)
    before = scene.snapshot()
    scene.set_shared_intrinsics(0, with_focal(400.0), -0.1 * FIRST)
    scene.restore(before)
    restored.load_state_dict(unflatten_state(flatten_state(scene.state_dict())))
    assert restored.keypoints.tobytes() == scene.keypoints.tobytes()
    assert restored.intrinsics.tobytes() == scene.intrinsics.tobytes()
    scene.set_shared_intrinsics(0, scene.intrinsics[0], 0.02 * FIRST)
    restored.load_state_dict(unflatten_state(flatten_state(scene.state_dict())))
    assert restored.keypoints.tobytes() == scene.keypoints.tobytes()


def test_project_returns_errors_and_depth_of_the_pinhole_model() -> None:
    scene = Scene(make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 20.0)))
    for image, pose in enumerate(arc_poses(3, 20.0)):
        scene.register(image, pose[:, :3], pose[:, 3])
    rng = np.random.default_rng(0)
    keypoints = rng.integers(0, len(scene.keypoints), 200)
    points = rng.normal(0, 3, (200, 3))
    errors_px, depth = scene.project(keypoints, points)
    for keypoint, point, error_px, z in zip(keypoints, points, errors_px, depth, strict=True):
        image = scene.graph.image_of[keypoint]
        local = scene.rotations[image] @ point + scene.translations[image]
        assert z == pytest.approx(local[2])
        xy = project(CAMERA, local[None])[0]
        expected = np.linalg.norm(xy - scene.keypoints[keypoint]) if local[2] > 0 else np.inf
        assert error_px == pytest.approx(expected)
    assert np.isinf(errors_px).any()
