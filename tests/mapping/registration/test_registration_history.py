"""Tests that the history of registration attempts is restored from a checkpoint."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.registration.registration_history import RegistrationHistory
from mpsfm_core.mapping.state import flatten_state, unflatten_state

OPTIONS = RegistrationOptions(max_resampled_attempts=1)


def test_history_restored_from_checkpoint_rejects_the_same_poses() -> None:
    pose = ScoredPose(np.eye(3), np.array([0.1, 1e-310, -3.0]), "lifted", 12.5, 11, 0.7)
    other = ScoredPose(np.eye(3), np.zeros(3), "lifted", 12.5, 11, 0.7, 500.0)
    history = RegistrationHistory(OPTIONS)
    history.record_attempt(3, [0, 2], pose, searched=True)
    history.record_attempt(4, [1], None, searched=False)
    history.reject_pose(3, pose, ImageReason.NO_POSE.because())
    history.record_contradiction(1, 3)
    history.record_contradiction(1, 4)
    history.excluded_references[3].add(1)
    restored = RegistrationHistory(OPTIONS)
    restored.load_state_dict(unflatten_state(flatten_state(history.state_dict())))
    assert restored.get_rejection(3, pose) == ImageReason.NO_POSE.because()
    assert restored.get_rejection(3, other) is None
    assert restored.count_searches(3) == 1 and restored.count_searches(4) == 0
    assert restored.is_exhausted(3, [0, 2]) and not restored.is_exhausted(3, [0])
    last = restored.get_last_pose(3)
    assert last is not None and last.translation.tobytes() == pose.translation.tobytes()
    assert restored.get_last_pose(4) is None
    assert restored.excluded_references == {3: {1}}
    registered = np.array([True, True, True, False, False])
    assert restored.pop_contradicted_image(registered) == (1, 2)
    restored.record_contradiction(1, 3)
    restored.record_contradiction(1, 4)
    assert restored.pop_contradicted_image(registered) is None
