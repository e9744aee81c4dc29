"""How the next image comes in: which one, by which pose, and what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data import Bool
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.refinement.filtering import filter_points, lost_images
from mpsfm_core.mapping.refinement.maintenance import Upkeep
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.image_selection import find_local_bundle, rank_next_images
from mpsfm_core.mapping.registration.pose_estimation import (
    AbsolutePoseEstimator,
    select_distinct_poses,
)
from mpsfm_core.mapping.registration.pose_support import ScoredPose, score_pose
from mpsfm_core.mapping.triangulation import triangulate_image

NUM_WIDE_REFERENCES = 10
"""Images beside which one is posed that matches want elsewhere (ours; 5 hold fewer images)."""


class IncrementalRegistration:
    """Registers image after image in the scene of a group."""

    def __init__(self, upkeep: Upkeep, search: AbsolutePoseEstimator) -> None:
        self._upkeep, self._search = upkeep, search
        self._scene, self._scores = upkeep.scene, upkeep.scores
        self._refiner, self._history = upkeep.refiner, upkeep.history
        self._thresholds, self._journal, self._options = (
            upkeep.thresholds,
            upkeep.journal,
            upkeep.options,
        )

    def register_next_image(self, available: Bool, *, wide: bool = False) -> bool:
        """Register one more image, relaxing step by step; False when none can be."""
        options = self._options.registration
        while True:
            trusted = np.where(self._history.excluded_references, 0, self._scores)
            ranked = rank_next_images(self._scene, trusted, available, options)
            if self._register_one_of(ranked, wide=False):
                return True
            if self.deregister_contradicted_image():
                continue
            if wide and self._register_one_of(ranked, wide=True):
                return True
            if not ranked or not self._thresholds.relax():
                return self._register_contradicted_image(available)

    def deregister_contradicted_image(self) -> bool:
        """Take out the image that most newcomers contradicted, if several did; each image once."""
        culprit = self._history.pop_contradicted_image(self._scene.registered)
        if culprit is None or self._upkeep.size <= 2:
            return False
        image, count = culprit
        reason = ImageReason.CONTRADICTED_BY_IMAGES.because(num_images=count)
        self._upkeep.drop([image], reason)
        self._history.clear()
        return True

    def _register_one_of(self, ranked: Sequence[tuple[int, int]], *, wide: bool) -> bool:
        """Register the first of some images that can be; each comes with a registered one."""
        for image, reference in ranked:
            references = self._references(image, reference, wide=wide)
            if self._known_to_fail(image, references):
                continue
            reason = self._register_image(image, references)
            if reason is None:
                self._thresholds.reset()
                self._upkeep.accept(image)
                return True
            self._journal.rejected(image, reason)
        return False

    def _register_contradicted_image(self, available: Bool) -> bool:
        """Register a contradicted image, if refining everything around it settles that.

        Where a loop closes, drift contradicts a right pose. False when none can be.
        """
        self._thresholds.reset()
        scores = np.where(self._history.excluded_references, self._scores, 0)
        options = self._options.registration
        for image, reference in rank_next_images(self._scene, scores, available, options):
            self._history.excluded_references[image] = False
            references = self._references(image, reference)
            if self._register_image(image, references, everything=True) is None:
                self._upkeep.accept(image)
                self._history.clear()
                return True
        return False

    def _references(self, image: int, reference: int, *, wide: bool = False) -> list[int]:
        """The registered images by whose points an image is posed.

        Those that share most points with the ``reference``; or, if ``wide``, match the image best.
        """
        scores, options = self._scores, self._options.registration
        if wide:
            matching = np.flatnonzero(self._scene.registered & (scores[image] > 0))
            order = np.argsort(-scores[image, matching], kind="stable")
            nearby = matching[order[:NUM_WIDE_REFERENCES]].tolist()
        else:
            nearby = find_local_bundle(self._scene, reference, options.num_neighbors, scores)
        return [other for other in nearby if not self._history.excluded_references[image, other]]

    def _known_to_fail(self, image: int, references: list[int]) -> bool:
        """Whether even the best pose of the same attempt before lacks support still."""
        if not self._history.is_exhausted(image, references):
            return False
        best = self._history.last_best_pose(image)
        return best is None or self._thresholds.check_support(best) is not None

    def _find_poses(
        self, image: int, references: list[int], found: PoseCorrespondences
    ) -> list[ScoredPose]:
        """Possible poses of an image, best first, that of earlier history among them."""
        options, history = self._options.registration, self._history
        poses = []
        known = history.last_best_pose(image)
        if known:
            poses.append(score_pose(self._scene, found, known.hypothesis, options))
        search = not history.is_exhausted(image, references)
        if search:
            poses += self._search.estimate_poses(image, found, attempt=history.num_searches(image))
        poses = select_distinct_poses(poses)
        history.record_attempt(image, references, poses[0] if poses else None, searched=search)
        return poses

    def _register_image(
        self, image: int, references: list[int], *, everything: bool = False
    ) -> Reason | None:
        """Register an image with the first of its possible poses that holds; None, or why not.

        ``everything``: refine all before the depth check, not just the image. Only a pose that
        nearly all matches support is worth that time.
        """
        scene = self._scene
        with self._journal.timed("registration"):
            found = find_correspondences(scene, image, references, self._options.registration)
            most = int(np.bincount(found.references, found.depth_weights, minlength=1).max())
            if most < self._thresholds.min_inliers:
                return ImageReason.TOO_FEW_POINTS.because(
                    num_matches=most, min_matches=self._thresholds.min_inliers
                )
            poses = self._find_poses(image, references, found)
        snapshot, noise = scene.snapshot(), self._refiner.noise
        reason: Reason | None = ImageReason.NO_POSE.because()
        for pose in poses:
            reason = self._thresholds.check_support(pose, certain=everything)
            if not everything:
                reason = reason or self._history.pose_rejection(image, pose)
            if reason is None:
                reason = self._extend_model(image, pose, found, everything=everything)
                if reason is None:
                    return None
                self._history.reject_pose(image, pose, reason)
                scene.restore(snapshot)
                self._refiner.noise = noise
                self._refiner.forget(image)
        return reason

    def _extend_model(
        self, image: int, pose: ScoredPose, found: PoseCorrespondences, *, everything: bool
    ) -> Reason | None:
        """Grow and refine the scene around a new pose; None, or why it is rejected."""
        scene, options = self._scene, self._options
        with self._journal.timed("local refinement"):
            scene.register(image, pose.rotation, pose.translation)
            triangulate_image(scene, image, options.triangulation)
            bundle = find_local_bundle(
                scene, image, options.refinement.local_images - 1, self._scores
            )
            self._refiner.estimate_scale(image, bundle[1:])
            wide = options.refinement.first_reprojection_scale
            self._refiner.adjust([image], local=True, reprojection_scale=wide)
            filter_points(scene, options.triangulation, [image])
            if image in lost_images(scene):
                return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
            self._refiner.estimate_scale(image, bundle[1:])
            self._refiner.integrate([image])
        if everything:
            with self._journal.timed("global refinement"):
                self._refiner.refine_locally(image)
                self._refiner.refine_globally()
        reason = self._upkeep.contradiction(image, self._options.consistency.max_violations)
        if reason:
            self._refute(image, pose, found)
            return reason
        with self._journal.timed("local refinement"):
            self._refiner.refine_locally(image)
        lost = lost_images(scene)
        if image in lost:
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        self._upkeep.drop(lost, ImageReason.LOST_POINTS.because(step="local-refinement"))
        return None

    def _refute(self, image: int, pose: ScoredPose, found: PoseCorrespondences) -> None:
        """Try an image no more beside those whose matches led to a contradicted pose."""
        for other in map(int, np.unique(found.references)):
            alone = found.select(found.references == other)
            options = self._options.registration
            led = score_pose(self._scene, alone, pose.hypothesis, options)
            self._history.excluded_references[image, other] |= (
                led.inlier_ratio >= options.min_inlier_share
            )
