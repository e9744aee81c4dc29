"""Schedule that relaxes the acceptance thresholds of poses if no image can be registered."""

from __future__ import annotations

from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.state import StateDict

RELAXATION_FACTOR = 1.2
"""Factor between the thresholds of two steps of the schedule. [reference]"""


class ThresholdSchedule:
    """Acceptance thresholds of poses that relax stepwise until an image is registered.

    As the inlier thresholds relax, the depth threshold tightens by the same factor, because a pose
    with fewer inliers needs a better depth agreement. The reference implementation of the paper
    relaxes all thresholds.
    """

    def __init__(self, options: RegistrationOptions) -> None:
        self._options = options
        self._num_relaxations = 0

    @property
    def min_inliers(self) -> int:
        """Minimum number of inliers of a pose at the present step of the schedule."""
        return int(self._options.min_inliers / self._factor)

    @property
    def min_inlier_ratio(self) -> float:
        """Minimum inlier ratio of a pose at the present step of the schedule."""
        return self._options.min_pose_inlier_ratio / self._factor

    def tighten_violations(self, max_violations: float) -> float:
        """Tighten the limit of the depth violation ratio to the present step of the schedule."""
        return max_violations / self._factor

    def check_support(self, pose: ScoredPose) -> Reason | None:
        """Return the reason why a pose has too little support, or None if the support suffices."""
        min_inliers, min_ratio = self.min_inliers, self.min_inlier_ratio
        if pose.num_inliers < min_inliers:
            return ImageReason.TOO_FEW_INLIERS.because(
                num_inliers=pose.num_inliers, min_inliers=min_inliers
            )
        if pose.inlier_ratio < min_ratio:
            return ImageReason.LOW_INLIER_RATIO.because(
                inlier_ratio=round(float(pose.inlier_ratio), 4),
                min_inlier_ratio=round(float(min_ratio), 4),
            )
        return None

    def relax(self) -> bool:
        """Relax the inlier thresholds by one step, and return False after the last step."""
        if self._num_relaxations == self._options.max_relaxations:
            return False
        self._num_relaxations += 1
        return True

    def reset(self) -> None:
        """Reset all thresholds to their initial values."""
        self._num_relaxations = 0

    def state_dict(self) -> StateDict:
        """Return the present step of the threshold schedule for a checkpoint."""
        return {"num_relaxations": self._num_relaxations}

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the present step of the threshold schedule from a checkpoint."""
        self._num_relaxations = state["num_relaxations"]

    @property
    def _factor(self) -> float:
        return RELAXATION_FACTOR**self._num_relaxations
