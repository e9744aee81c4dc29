"""Tests of the scene: rollback of focal lengths and distortion, and checkpoint state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.mapping.scene.estimated_intrinsics import (
    CalibrationOutcome,
    IntrinsicEstimate,
    IntrinsicParameter,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from tests.mapping.focal_scenes import CAMERA, guess_focals, make_room


def test_restore_undoes_focal_lengths_and_outcomes() -> None:
    scene = Scene(guess_focals(make_room(), [1.1] * 5))
    before = scene.snapshot()
    scene.set_shared_intrinsics(0, np.array([400.0, 400.0]), 0.0)
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


@pytest.mark.parametrize("radial", [0.0, 0.05])
@pytest.mark.parametrize("focal", [1.0, 1.2])
def test_scene_restored_from_checkpoint_has_identical_keypoints(
    radial: float, focal: float
) -> None:
    """The distortion of the first scene changed and was rolled back before the checkpoint."""
    problem = guess_focals(make_room(), [1.1] * 5)
    problem = replace(problem, images=tuple(replace(i, radial=radial) for i in problem.images))
    scene, restored = Scene(problem), Scene(problem)
    scene.set_shared_intrinsics(0, focal * CAMERA.params[:2], radial)
    before = scene.snapshot()
    scene.set_shared_intrinsics(0, np.array([400.0, 400.0]), -0.1)
    scene.restore(before)
    restored.load_state_dict(unflatten_state(flatten_state(scene.state_dict())))
    assert restored.keypoints.tobytes() == scene.keypoints.tobytes()
    assert restored.intrinsics.tobytes() == scene.intrinsics.tobytes()
    scene.set_shared_intrinsics(0, scene.intrinsics[0, :2], 0.02)
    restored.load_state_dict(unflatten_state(flatten_state(scene.state_dict())))
    assert restored.keypoints.tobytes() == scene.keypoints.tobytes()
