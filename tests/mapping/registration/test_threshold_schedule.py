"""Test of the threshold schedule: inlier thresholds relax, the depth threshold tightens."""

from __future__ import annotations

import pytest

from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.threshold_schedule import ThresholdSchedule


def test_relax_lowers_inlier_thresholds_and_tightens_depth_threshold() -> None:
    options = RegistrationOptions(min_inliers=36, min_pose_inlier_ratio=0.72, max_relaxations=2)
    schedule = ThresholdSchedule(options)
    found = []
    while True:
        found.append(
            (schedule.min_inliers, schedule.min_inlier_ratio, schedule.tighten_violations(0.036))
        )
        if not schedule.relax():
            break
    assert found == [
        (36, pytest.approx(0.72), pytest.approx(0.036)),
        (30, pytest.approx(0.60), pytest.approx(0.030)),
        (25, pytest.approx(0.50), pytest.approx(0.025)),
    ]
    schedule.reset()
    assert schedule.tighten_violations(0.036) == 0.036
