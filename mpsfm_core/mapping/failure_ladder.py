"""What to relax when no image can be registered any more (reference's order)."""

from __future__ import annotations

from mpsfm_core.mapping.options import ConsistencyOptions, RegistrationOptions


class FailureLadder:
    """Thresholds that give way step by step and snap back at the next success.

    First the depth check is relaxed, then skipped; then PnP may do with fewer inliers.
    """

    def __init__(self, registration: RegistrationOptions, consistency: ConsistencyOptions) -> None:
        self._registration = registration
        self._consistency = consistency
        self.reset()

    def reset(self) -> None:
        """Back to the strict thresholds, after a success."""
        self._check_relaxations = 0
        self._inlier_relaxations = 0
        self.check_failures = 0

    @property
    def max_violations(self) -> float | None:
        """Share of violating pixels that rejects an image; None: no check."""
        options = self._consistency
        threshold = options.max_violations * options.relaxation**self._check_relaxations
        skipped = self._check_relaxations > options.max_relaxations or threshold >= 1
        return threshold if options.enabled and not skipped else None

    @property
    def min_inliers(self) -> int:
        """PnP inliers that an image needs."""
        return int(self._registration.min_inliers / 1.2**self._inlier_relaxations)

    @property
    def min_inlier_share(self) -> float:
        """Share of the correspondences that must be inliers."""
        return self._registration.min_inlier_share / 1.2**self._inlier_relaxations

    @property
    def enough_failures(self) -> bool:
        """So many images failed the depth check that it should be relaxed at once."""
        return self.check_failures >= self._consistency.num_failures

    def relax(self) -> bool:
        """One step down; False at the bottom."""
        if self.check_failures and self.max_violations is not None:
            self._check_relaxations += 1
        elif self._inlier_relaxations < self._registration.max_relaxations:
            self._inlier_relaxations += 1
        else:
            return False
        self.check_failures = 0
        return True
