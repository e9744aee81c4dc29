"""What keeps the scene of a group right while it grows: refinement of everything, the depth check,
and who goes when it fails."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingProblem
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.consistency.depth_consistency import DepthConsistencyCheck
from mpsfm_core.mapping.event_log import Journal
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.depth_noise import DepthNoise
from mpsfm_core.mapping.refinement.filtering import disconnected_images, lost_images
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.image_selection import compute_pair_scores
from mpsfm_core.mapping.registration.registration_history import RegistrationHistory
from mpsfm_core.mapping.registration.threshold_schedule import ThresholdSchedule
from mpsfm_core.mapping.scene.scene import Scene, Snapshot

JUMP_DEG = 3.0
"""A camera that turns more in a global refinement may have found a wrong minimum (ours)."""


class State(NamedTuple):
    """To return to: the scene, which of its images were checked, and what was measured of noise."""

    scene: Snapshot
    checked: Bool
    noise: DepthNoise
    loss_scale: float


class Upkeep:
    """The scene of a group. ``scores`` (n, n): of the matches of each two images."""

    def __init__(self, problem: MappingProblem, options: MapperOptions, journal: Journal) -> None:
        self.problem, self.options, self.journal = problem, options, journal
        self.scene = Scene(problem, weigh_by_score=options.weigh_by_score)
        self.scores = compute_pair_scores(self.scene, options.registration.next_view)
        self.refiner = Refiner(self.scene, options, self.scores)
        self.history = RegistrationHistory(self.scene.num_images, options.registration)
        self.thresholds = ThresholdSchedule(options.registration)
        self._check = DepthConsistencyCheck(self.scene, options.consistency)
        self._last_size = (0, 0)
        self._checked: Bool = np.zeros(self.scene.num_images, dtype=np.bool_)

    @property
    def size(self) -> int:
        """Number of registered images."""
        return int(self.scene.registered.sum())

    @property
    def all_checked(self) -> bool:
        """Whether no image came since all were compared with each other."""
        return bool(self._checked[self.scene.registered].all())

    def state(self) -> State:
        """To :meth:`restore`."""
        measured = self.refiner.noise, self.refiner.loss_scale
        return State(self.scene.snapshot(), self._checked.copy(), *measured)

    def restore(self, state: State) -> None:
        """Return to an earlier state; what was tried in between may be tried again."""
        self.scene.restore(state.scene)
        self._checked = state.checked.copy()
        self.refiner.noise, self.refiner.loss_scale = state.noise, state.loss_scale
        self.history.clear()

    def empty(self, before: Snapshot) -> None:
        """Return to a scene without images, as if nothing had been."""
        self.scene.restore(before)
        self.refiner.forget_all()
        self._checked[:] = False
        self._last_size = (0, 0)

    def refresh(self) -> None:
        """Refine everything, if images or points grew so much since the last time."""
        images, points = self.size, len(self.scene.tracks)
        growth = 1 + self.options.refinement.global_growth
        if images > growth * self._last_size[0] or points > growth * self._last_size[1]:
            self.refine_globally()

    def refine_globally(self, *, final: bool = False) -> None:
        """Refine all images and points; those that lose their points by it go."""
        before = self.scene.snapshot()
        with self.journal.timed("global refinement"):
            self.refiner.refine_globally(final=final)
            self.scene.tracks.compact()
        self._undo_jump(before)
        self.history.clear()
        self._last_size = self.size, len(self.scene.tracks)
        self.drop(
            lost_images(self.scene), ImageReason.LOST_POINTS.because(step="global-refinement")
        )
        self.journal.scene_changed(self.scene)

    def check_all(self, limit: float, step: str) -> None:
        """Deregister images until no two views contradict each other.

        Those that held before are not compared with each other again.
        """
        images = self.scene.registered & ~self._checked
        self._checked |= images
        conflicting = self._conflicts(np.flatnonzero(images), limit)
        for image, share in conflicting:
            ratio = round(float(share), 4)
            reason = ImageReason.CONTRADICTS_DEPTH.because(violation_ratio=ratio, step=step)
            self.drop([image], reason)
        if conflicting:
            apart = disconnected_images(self.scene)
            self.drop(apart, ImageReason.CONNECTED_BY_DROPPED_IMAGE.because(step=step))

    def contradiction(self, image: int, limit: float) -> Reason | None:
        """Why the depth of an image contradicts that of another view, if it does.

        ``limit``: share of pixels at the strict thresholds.
        """
        if not self.options.consistency.enabled:
            return None
        limit = self.thresholds.max_violations(limit)
        with self.journal.timed("depth check"):
            check = self._check.check_image(image, self.refiner.std_factor, limit)
        if check.share <= limit:
            return None
        self.history.record_contradiction(check.other, image)
        other = self.problem.images[check.other].name
        ratio = round(float(check.share), 4)
        return ImageReason.CONTRADICTS_IMAGE.because(violation_ratio=ratio, other_image=other)

    def accept(self, image: int) -> None:
        """Tell of an image that was registered."""
        self.history.clear_pose_rejections()
        self.journal.registered(image, self.size)
        self.journal.scene_changed(self.scene)

    def drop(self, images: list[int], reason: Reason) -> None:
        """Take images out that were registered before; the run goes on."""
        for image in images:
            if self.refiner.fixed[image]:
                continue
            self._checked[image] = False
            self.scene.deregister(image)
            self.refiner.forget(image)
            self.history.clear_pose_rejections()
            self.journal.rejected(image, reason)

    def _undo_jump(self, before: Snapshot) -> None:
        """Return to an earlier state if cameras jumped and their depth contradicts since then.

        A robust loss has many minima; where few matches hold images, the next one may be wrong.
        """
        images = self.scene.registered_images()
        turns = self.scene.rotations[images] @ before.rotations[images].transpose(0, 2, 1)
        if not len(images) or rotation_angle_deg(turns).max() < JUMP_DEG:
            return
        limit = self.options.consistency.max_violations
        after, worse = self.scene.snapshot(), len(self._conflicts(images, limit))
        self.scene.restore(before)
        if not worse > len(self._conflicts(images, limit)):
            self.scene.restore(after)

    def _conflicts(self, images: Int64, limit: float) -> list[tuple[int, float]]:
        """Views to leave out so that none contradicts one of the images, and how much each did."""
        if not self.options.consistency.enabled:
            return []
        with self.journal.timed("depth check"):
            return self._check.find_conflicting_images(images, limit, self.refiner.std_factor)
