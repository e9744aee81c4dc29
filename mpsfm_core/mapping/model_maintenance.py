"""Maintenance of a growing model: global refinement, depth checks, deregistration, rollback."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingProblem
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.consistency.depth_consistency import DepthConsistencyCheck
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.depth_noise import DepthNoise
from mpsfm_core.mapping.refinement.filtering import find_disconnected_images, find_lost_images
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.image_selection import compute_pair_scores
from mpsfm_core.mapping.registration.registration_history import RegistrationHistory
from mpsfm_core.mapping.registration.threshold_schedule import ThresholdSchedule
from mpsfm_core.mapping.scene.scene import Scene, Snapshot
from mpsfm_core.mapping.state import StateDict, Stateful
from mpsfm_core.support.memory import release_free_memory

GLOBAL_GROWTH = 0.3
"""Relative growth of the number of images or points after which all images are refined.
[reference]"""


class ModelState(NamedTuple):
    """Copy of the state of a model, for a rollback."""

    scene: Snapshot
    checked: Bool
    """(n,) bool mask of the images whose depth was compared with all other images."""
    keeps_depth_map: Bool
    """See :class:`Refiner`."""
    noise: DepthNoise
    loss_scale: float
    """Measured scale of the reprojection loss, in standard deviations of the keypoint position."""
    calibrates_with_long_tracks: bool
    """See :class:`Refiner`."""
    is_refined: bool
    """See :class:`ModelMaintenance`."""


class ModelMaintenance:
    """Model of one component, with refinement, depth checks, deregistration and rollback.

    Attributes:
        scene: Camera poses, 3D points and depth maps of the model.
        scores: (n, n) sparse matrix of the summed match scores of each two images.
        refiner: Object that runs bundle adjustment and depth integration.
        history: Record of failed and successful image registration attempts.
        thresholds: Acceptance thresholds of image registration, which relax if no image can be
            registered.
        is_refined: True if no image was registered or deregistered after the last global
            refinement.
    """

    def __init__(
        self, problem: MappingProblem, options: MapperOptions, event_log: EventLog
    ) -> None:
        self.problem, self.options, self.event_log = problem, options, event_log
        self.scene = Scene(problem, weigh_by_score=options.weigh_by_score)
        self.scores = compute_pair_scores(self.scene)
        self.refiner = Refiner(self.scene, options, self.scores)
        self.history = RegistrationHistory(options.registration)
        self.thresholds = ThresholdSchedule(options.registration)
        self._depth_check = DepthConsistencyCheck(self.scene, options.consistency)
        self.is_refined = False
        self._last_size = (0, 0)
        self._checked: Bool = np.zeros(self.scene.num_images, dtype=np.bool_)
        self._wrong_depth: frozenset[int] = frozenset()
        self._checks_new_images = True

    @property
    def size(self) -> int:
        """Number of registered images."""
        return int(self.scene.registered.sum())

    @property
    def is_checked(self) -> bool:
        """True if the depth of all pairs of registered images was compared."""
        return bool(self._checked[self.scene.registered].all())

    def state(self) -> ModelState:
        """Return a copy of the model for :meth:`restore`."""
        refiner = self.refiner
        return ModelState(
            self.scene.snapshot(),
            self._checked.copy(),
            refiner.keeps_depth_map.copy(),
            refiner.noise,
            refiner.loss_scale,
            refiner.calibrates_with_long_tracks,
            self.is_refined,
        )

    def restore(self, state: ModelState) -> None:
        """Roll back to an earlier model state and clear the history of later registrations."""
        refiner = self.refiner
        self.scene.restore(state.scene)
        self._checked, self.is_refined = state.checked.copy(), state.is_refined
        refiner.keeps_depth_map = state.keeps_depth_map.copy()
        refiner.noise, refiner.loss_scale = state.noise, state.loss_scale
        refiner.calibrates_with_long_tracks = state.calibrates_with_long_tracks
        self.history.clear()

    def state_dict(self) -> StateDict:
        """Return the state of the model for a checkpoint."""
        parts = {name: part.state_dict() for name, part in self._parts().items()}
        return {
            **parts,
            "last_size": self._last_size,
            "checked": self._checked,
            "is_refined": self.is_refined,
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the state of the model from a checkpoint of the same mapping problem."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self._last_size = tuple(state["last_size"])
        self._checked, self.is_refined = state["checked"], state["is_refined"]

    def _parts(self) -> dict[str, Stateful]:
        """Return the model parts that a checkpoint stores, in their order of restoration."""
        return {
            "scene": self.scene,
            "refiner": self.refiner,
            "history": self.history,
            "thresholds": self.thresholds,
            "depth_check": self._depth_check,
        }

    def clear(self, empty: Snapshot) -> None:
        """Reset the model to a scene without registered images."""
        self.scene.restore(empty)
        self.refiner.reset()
        self._checked[:] = False
        self._last_size, self.is_refined = (0, 0), False

    def refine_if_grown(self) -> None:
        """Run global refinement if the model has grown by the ratio ``GLOBAL_GROWTH``.

        The numbers of images and points are compared with those after the last global refinement.
        Call this method after the registration of an image.
        """
        self.is_refined = False
        num_images, num_points = self.size, len(self.scene.tracks)
        growth = 1 + GLOBAL_GROWTH
        if num_images > growth * self._last_size[0] or num_points > growth * self._last_size[1]:
            self.refine_globally()

    def refine_new_images(self) -> bool:
        """Run global refinement if the number of images has grown since the last one.

        Call this method if no further image can be registered. If none can be registered afterwards
        either, this refinement is the last one.

        Returns:
            True if the images were refined.
        """
        is_larger = self.size > self._last_size[0]
        if is_larger:
            self.refiner.calibrates_with_long_tracks = True
            self.refine_globally()
        return is_larger

    def refine_globally(self) -> None:
        """Refine all images and points, then deregister images with few or unconnected points."""
        with self.event_log.timed("global refinement"):
            self.refiner.refine_globally()
            self.scene.tracks.compact()
            release_free_memory()
        self.history.clear()
        self._last_size = self.size, len(self.scene.tracks)
        reason = ImageReason.LOST_POINTS.because(step="global-refinement")
        self.deregister(find_lost_images(self.scene), reason)
        self.deregister_disconnected(ImageReason.DISCONNECTED.because(step="global-refinement"))
        self.is_refined = True
        self.event_log.scene_changed(self.scene)

    def check_all_images(
        self, max_violations: float, step: str, compared: Sequence[Int64] = ()
    ) -> None:
        """Deregister images until no two registered images contradict each other's depth.

        Image pairs whose depth was compared before are not compared again.

        Args:
            max_violations: Largest accepted share of pixels with contradicting depth, without
                outliers of the depth priors.
            step: Name of the mapper step that the recorded rejection reason contains.
            compared: Sets of images whose depth was compared with each other.
        """
        images = self.scene.registered & ~self._checked
        self._checked |= images
        conflicting = self._find_conflicts(np.flatnonzero(images), max_violations, compared)
        release_free_memory()
        conflicting = self._select_conflicting_frames(conflicting)
        for image, violation_ratio in conflicting:
            ratio = round(float(violation_ratio), 4)
            reason = ImageReason.CONTRADICTS_DEPTH.because(violation_ratio=ratio, step=step)
            self.deregister([image], reason)
        if conflicting:
            reason = ImageReason.CONNECTED_BY_DROPPED_IMAGE.because(step=step)
            self.deregister(find_disconnected_images(self.scene), reason)

    def _select_conflicting_frames(
        self, conflicting: list[tuple[int, float]]
    ) -> list[tuple[int, float]]:
        """Select the conflicting images of frames in which most images have conflicting depth."""
        frames = self.scene.rigs.frame_of
        images = np.array([image for image, _ in conflicting], dtype=np.int64)
        num_conflicting = np.bincount(frames[images], minlength=len(frames))
        is_majority = 2 * num_conflicting > np.bincount(frames, minlength=len(frames))
        return [(image, ratio) for image, ratio in conflicting if is_majority[frames[image]]]

    def deregister_disconnected(self, reason: Reason) -> None:
        """Deregister images that no chain of points connects to the largest part of the model.

        Images with known poses stay registered, unless the known poses are only initial guesses.
        """
        has_pose = np.array([image.known_pose is not None for image in self.problem.images])
        stays = has_pose & (self.options.known_poses != "guess")
        disconnected = find_disconnected_images(self.scene)
        self.deregister([image for image in disconnected if not stays[image]], reason)

    def check_depth(self, image: int, max_violations: float) -> Reason | None:
        """Check the depth of a new image against the images that it overlaps (paper 3.4).

        Args:
            image: The image.
            max_violations: Largest accepted share of pixels with contradicting depth, without
                outliers of the depth priors and before thresholds relax.

        Returns:
            None if the depth of the image is consistent, else the rejection reason.
        """
        if not self.options.consistency.enabled or not self._checks_new_images:
            return None
        limit = self.thresholds.tighten_violations(max_violations)
        limit += self.refiner.noise.outlier_ratio
        with self.event_log.timed("depth check"):
            violation = self._depth_check.check_image(
                image, self.refiner.std_factor, limit, self._wrong_depth
            )
        if violation.ratio <= limit:
            return None
        self.history.record_contradiction(violation.other_image, image)
        other = self.problem.images[violation.other_image].name
        ratio = round(float(violation.ratio), 4)
        return ImageReason.CONTRADICTS_IMAGE.because(violation_ratio=ratio, other_image=other)

    def find_wrong_depth(self) -> list[int]:
        """Find registered images with exact poses whose depth contradicts other such images."""
        limit = self.options.consistency.max_violations
        return [image for image, _ in self._find_conflicts(self.scene.registered_images(), limit)]

    def exclude_depth(self, images: Iterable[int]) -> None:
        """Exclude images with wrong depth from the depth check of new images."""
        self._wrong_depth = frozenset(images)

    @contextmanager
    def depth_check_disabled(self) -> Iterator[None]:
        """Register new images without the check of their depth inside a ``with`` block."""
        check, self._checks_new_images = self._checks_new_images, False
        try:
            yield
        finally:
            self._checks_new_images = check

    def confirm(self, image: int) -> None:
        """Notify the event receiver of a verified registration, and allow rejected poses again."""
        self.history.clear_pose_rejections()
        for member in self.scene.rigs.images_of(image):
            self.event_log.registered(member, self.size)
        self.event_log.scene_changed(self.scene)

    def deregister(self, images: list[int], reason: Reason) -> None:
        """Deregister images with all images of their frames, except those with a fixed pose."""
        for image in self.scene.rigs.complete(images):
            if self.refiner.fixed[image]:
                continue
            self._checked[image] = self.is_refined = False
            self.refiner.keeps_depth_map[image] = False
            self.scene.deregister(image)
            self.history.clear_pose_rejections()
            self.event_log.rejected(image, reason)

    def _find_conflicts(
        self, images: Int64, limit: float, compared: Sequence[Int64] = ()
    ) -> list[tuple[int, float]]:
        """Find images to deregister so that no depth map contradicts the depth of ``images``."""
        if not self.options.consistency.enabled:
            return []
        limit += self.refiner.noise.outlier_ratio
        with self.event_log.timed("depth check"):
            return self._depth_check.find_conflicting_images(
                images, limit, self.refiner.std_factor, compared
            )
