"""What gives way when no image can be registered, and what tightens meanwhile."""

from __future__ import annotations

import pytest

from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.threshold_schedule import ThresholdSchedule


def test_depth_has_to_bear_out_what_matches_lack() -> None:
    """Each step asks less of matches and, by the same factor, more of the depth check."""
    options = RegistrationOptions(min_inliers=36, min_inlier_share=0.72, max_relaxations=2)
    ladder = ThresholdSchedule(options)
    found = []
    while True:
        found.append(
            (ladder.min_inliers, ladder.min_inlier_ratio, ladder.tighten_violations(0.036))
        )
        if not ladder.relax():
            break
    assert found == [
        (36, pytest.approx(0.72), pytest.approx(0.036)),
        (30, pytest.approx(0.60), pytest.approx(0.030)),
        (25, pytest.approx(0.50), pytest.approx(0.025)),
    ]
    ladder.reset()
    assert ladder.tighten_violations(0.036) == 0.036
