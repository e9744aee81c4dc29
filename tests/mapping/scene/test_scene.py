"""Scene: rollback of focal lengths."""

from __future__ import annotations

import numpy as np

from mpsfm_core.mapping.scene.calibration_outcome import CalibrationOutcome
from mpsfm_core.mapping.scene.scene import Scene
from tests.mapping.focal_scenes import CAMERA, guess_focals, make_room


def test_restore_undoes_focal_lengths_and_outcomes() -> None:
    scene = Scene(guess_focals(make_room(), [1.1] * 5))
    before = scene.snapshot()
    scene.set_shared_focal(0, 400.0, 400.0)
    scene.set_focal_outcome(0, CalibrationOutcome.REFINED, 0.02, 400.0)
    scene.restore(before)
    assert (scene.intrinsics[:, 0] == 1.1 * CAMERA.fx).all()
    assert not scene.focal_outcome.any()
    assert np.isnan(scene.focal_log_std).all() and np.isnan(scene.focal_estimate_px).all()
