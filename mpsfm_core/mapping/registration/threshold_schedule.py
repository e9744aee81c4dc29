"""What to relax when no image can be registered any more."""

from __future__ import annotations

from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_support import ScoredPose


class ThresholdSchedule:
    """Thresholds that give way step by step and snap back at the next success.

    PnP may do with fewer inliers (reference). The depth check does not give way, unlike the
    reference's: that would let in what it is there to keep out. It tightens by the same factor, as
    what matches do not bear out depth has to (ours).
    """

    def __init__(self, options: RegistrationOptions) -> None:
        self._options = options
        self._relaxations = 0

    def reset(self) -> None:
        """Back to the strict thresholds, after a success."""
        self._relaxations = 0

    @property
    def min_inliers(self) -> int:
        """PnP inliers that an image needs."""
        return int(self._options.min_inliers / self._factor)

    @property
    def min_inlier_share(self) -> float:
        """Share of the correspondences that must be inliers."""
        return self._options.min_inlier_share / self._factor

    def max_violations(self, strict: float) -> float:
        """Share of pixels that may contradict another view, ``strict`` before any relaxation."""
        return strict / self._factor

    def check_support(self, pose: ScoredPose, *, certain: bool = False) -> Reason | None:
        """Why too few matches agree with a pose, if so; ``certain``: nearly all have to."""
        needed = self.min_inliers
        share = self._options.confident_share if certain else self.min_inlier_share
        if pose.num_inliers < needed:
            return ImageReason.TOO_FEW_INLIERS.because(
                num_inliers=pose.num_inliers, min_inliers=needed
            )
        if pose.inlier_ratio < share:
            return ImageReason.LOW_INLIER_RATIO.because(
                inlier_ratio=round(float(pose.inlier_ratio), 4),
                min_inlier_ratio=round(float(share), 4),
            )
        return None

    def relax(self) -> bool:
        """One step down; False at the bottom."""
        if self._relaxations == self._options.max_relaxations:
            return False
        self._relaxations += 1
        return True

    @property
    def _factor(self) -> float:
        return 1.2**self._relaxations
