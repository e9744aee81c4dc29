"""How the next image comes in: which one, by which pose, and what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data import Bool
from mpsfm_core.mapping.refinement.filtering import filter_points, lost_images
from mpsfm_core.mapping.refinement.maintenance import Upkeep
from mpsfm_core.mapping.registration.correspondences import Correspondences, correspondences
from mpsfm_core.mapping.registration.image_selection import local_bundle, rank_next_images
from mpsfm_core.mapping.registration.pose_support import AbsolutePose, rate_pose
from mpsfm_core.mapping.registration.registration import PoseSearch, distinct
from mpsfm_core.mapping.triangulation import triangulate_image

WIDE_REFERENCES = 10
"""Images beside which one is posed that matches want elsewhere (ours; 5 hold fewer images)."""


class Growth:
    """Registers image after image in the scene of a group."""

    def __init__(self, upkeep: Upkeep, search: PoseSearch) -> None:
        self._upkeep, self._search = upkeep, search
        self._scene, self._scores = upkeep.scene, upkeep.scores
        self._refiner, self._attempts = upkeep.refiner, upkeep.attempts
        self._ladder, self._journal, self._options = upkeep.ladder, upkeep.journal, upkeep.options

    def register_next(self, available: Bool, *, wide: bool = False) -> bool:
        """Register one more image, relaxing step by step; False when none can be."""
        options = self._options.registration
        while True:
            trusted = np.where(self._attempts.refuted, 0, self._scores)
            ranked = rank_next_images(self._scene, trusted, available, options)
            if self._register_one_of(ranked, wide=False):
                return True
            if self.displace():
                continue
            if wide and self._register_one_of(ranked, wide=True):
                return True
            if not ranked or not self._ladder.relax():
                return self._reconsider(available)

    def displace(self) -> bool:
        """Take out the image that most newcomers contradicted, if several did; each image once."""
        culprit = self._attempts.take_culprit(self._scene.registered)
        if culprit is None or self._upkeep.size <= 2:
            return False
        image, count = culprit
        self._upkeep.drop([image], f"{count} other images contradict its depth")
        self._attempts.forget()
        return True

    def _register_one_of(self, ranked: Sequence[tuple[int, int]], *, wide: bool) -> bool:
        """Register the first of some images that can be; each comes with a registered one."""
        for image, reference in ranked:
            references = self._references(image, reference, wide=wide)
            if self._known_to_fail(image, references):
                continue
            reason = self._try_image(image, references)
            if reason is None:
                self._ladder.reset()
                self._upkeep.accept(image)
                return True
            self._journal.rejected(image, reason)
        return False

    def _reconsider(self, available: Bool) -> bool:
        """Register a contradicted image, if refining everything around it settles that.

        Where a loop closes, drift contradicts a right pose. False when none can be.
        """
        self._ladder.reset()
        scores = np.where(self._attempts.refuted, self._scores, 0)
        options = self._options.registration
        for image, reference in rank_next_images(self._scene, scores, available, options):
            self._attempts.refuted[image] = False
            references = self._references(image, reference)
            if self._try_image(image, references, everything=True) is None:
                self._upkeep.accept(image)
                self._attempts.forget()
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
            nearby = matching[order[:WIDE_REFERENCES]].tolist()
        else:
            nearby = local_bundle(self._scene, reference, options.num_neighbors, scores)
        return [other for other in nearby if not self._attempts.refuted[image, other]]

    def _known_to_fail(self, image: int, references: list[int]) -> bool:
        """Whether even the best pose of the same attempt before lacks support still."""
        if not self._attempts.exhausted(image, references):
            return False
        best = self._attempts.best_pose(image)
        return best is None or self._ladder.objection(best) is not None

    def _find_poses(
        self, image: int, references: list[int], found: Correspondences
    ) -> list[AbsolutePose]:
        """Possible poses of an image, best first, that of earlier attempts among them."""
        options, attempts = self._options.registration, self._attempts
        poses = []
        known = attempts.best_pose(image)
        if known:
            poses.append(rate_pose(self._scene, found, known.hypothesis, options))
        search = not attempts.exhausted(image, references)
        if search:
            poses += self._search.poses(image, found, attempt=attempts.searches(image))
        poses = distinct(poses)
        attempts.remember(image, references, poses[0] if poses else None, searched=search)
        return poses

    def _try_image(
        self, image: int, references: list[int], *, everything: bool = False
    ) -> str | None:
        """Register an image with the first of its possible poses that holds; None, or why not.

        ``everything``: refine all before the depth check, not just the image. Only a pose that
        nearly all matches support is worth that time.
        """
        scene = self._scene
        with self._journal.timed("registration"):
            found = correspondences(scene, image, references, self._options.registration)
            most = int(np.bincount(found.references, found.worth, minlength=1).max())
            if most < self._ladder.min_inliers:
                return f"{most} matches have a 3D point, {self._ladder.min_inliers} are needed"
            poses = self._find_poses(image, references, found)
        snapshot, noise = scene.snapshot(), self._refiner.noise
        reason: str | None = "neither PnP nor an essential matrix gives a pose"
        for pose in poses:
            reason = self._ladder.objection(pose, certain=everything)
            if not everything:
                reason = reason or self._attempts.refusal(image, pose)
            if reason is None:
                reason = self._try_pose(image, pose, found, everything=everything)
                if reason is None:
                    return None
                self._attempts.refuse(image, pose, reason)
                scene.restore(snapshot)
                self._refiner.noise = noise
                self._refiner.forget(image)
        return reason

    def _try_pose(
        self, image: int, pose: AbsolutePose, found: Correspondences, *, everything: bool
    ) -> str | None:
        """Grow and refine the scene around a new pose; None, or why it is rejected."""
        scene, options = self._scene, self._options
        with self._journal.timed("local refinement"):
            scene.register(image, pose.rotation, pose.translation)
            triangulate_image(scene, image, options.triangulation)
            bundle = local_bundle(scene, image, options.refinement.local_images - 1, self._scores)
            self._refiner.estimate_scale(image, bundle[1:])
            wide = options.refinement.first_reprojection_scale
            self._refiner.adjust([image], local=True, reprojection_scale=wide)
            filter_points(scene, options.triangulation, [image])
            if image in lost_images(scene):
                return "too few points are left after refinement"
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
            return "too few points are left after refinement"
        self._upkeep.drop(lost, "lost its points when another image was refined")
        return None

    def _refute(self, image: int, pose: AbsolutePose, found: Correspondences) -> None:
        """Try an image no more beside those whose matches led to a contradicted pose."""
        for other in map(int, np.unique(found.references)):
            alone = found.select(found.references == other)
            options = self._options.registration
            led = rate_pose(self._scene, alone, pose.hypothesis, options)
            self._attempts.refuted[image, other] |= led.inlier_share >= options.min_inlier_share
