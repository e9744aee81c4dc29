"""Incremental registration of the next image, with verification and rollback."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data import Bool
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.model_maintenance import ModelMaintenance
from mpsfm_core.mapping.refinement.depth_noise import DepthNoise
from mpsfm_core.mapping.refinement.filtering import filter_points, find_lost_images
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.image_selection import rank_next_images
from mpsfm_core.mapping.registration.pose_estimation import (
    AbsolutePoseEstimator,
    select_distinct_poses,
)
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.scene.local_bundle import find_local_bundle
from mpsfm_core.mapping.scene.scene import Snapshot
from mpsfm_core.mapping.triangulation import triangulate_image

NUM_WIDE_REFERENCES = 10
"""Number of best matching reference images for the re-registration of misregistered images.
[ours]"""


class IncrementalRegistration:
    """Registration of further images into the scene of a component."""

    def __init__(
        self, maintenance: ModelMaintenance, pose_estimator: AbsolutePoseEstimator
    ) -> None:
        self._maintenance, self._pose_estimator = maintenance, pose_estimator
        self._scene, self._scores = maintenance.scene, maintenance.scores
        self._refiner, self._history = maintenance.refiner, maintenance.history
        self._thresholds, self._options = maintenance.thresholds, maintenance.options
        self._event_log = maintenance.event_log

    def register_next_image(self, candidates: Bool, *, wide: bool = False) -> bool:
        """Register the next image, and relax the thresholds until an image is registered.

        Args:
            candidates: (n,) bool mask of the images that may be registered.
            wide: If registration with the local bundle of the best matching image fails, try the
                best matching images as references before the acceptance thresholds relax.

        Returns:
            False if no image can be registered at the most relaxed thresholds.
        """
        while True:
            scores = self._history.select_scores(self._scores)
            ranked = rank_next_images(self._scene, scores, candidates)
            if self._register_first_possible(ranked, wide=False):
                return True
            if self.deregister_contradicted_image():
                continue
            if wide and self._register_first_possible(ranked, wide=True):
                return True
            if ranked and self._thresholds.relax():
                continue
            self._thresholds.reset()
            if not self._refine_for_contradicted(candidates):
                return False

    def deregister_contradicted_image(self) -> bool:
        """Deregister the image whose depth several rejected images contradict.

        Each image is deregistered at most once. Returns False if the depth of no registered image
        is contradicted.
        """
        contradicted = self._history.pop_contradicted_image(self._scene.registered)
        if contradicted is None or self._maintenance.size <= 2:
            return False
        image, num_images = contradicted
        reason = ImageReason.CONTRADICTED_BY_IMAGES.because(num_images=num_images)
        self._maintenance.deregister([image], reason)
        self._history.clear()
        return True

    def _register_first_possible(self, ranked: Sequence[tuple[int, int]], *, wide: bool) -> bool:
        """Register the first of the ranked images that passes verification.

        Args:
            ranked: Unregistered images in order of rank, each with its best matching registered
                image.
            wide: See :meth:`register_next_image`.
        """
        for image, best_match in ranked:
            references = self._select_references(image, best_match, wide=wide)
            if self._would_fail_again(image, references):
                continue
            reason = self._register_image(image, references)
            if reason is None:
                self._thresholds.reset()
                self._maintenance.confirm(image)
                return True
            self._event_log.rejected(image, reason)
        return False

    def _refine_for_contradicted(self, candidates: Bool) -> bool:
        """Refine all images if the depth of a candidate image contradicts the scene.

        Without global refinement, the drift of new images can make a correct pose contradict the
        depth of the scene. Returns False if the images were not refined.
        """
        contradicted = list(self._history.excluded_references)
        waits = (candidates & ~self._scene.registered)[contradicted].any()
        return bool(waits) and self._maintenance.refine_new_images()

    def _select_references(self, image: int, best_match: int, *, wide: bool = False) -> list[int]:
        """Select the registered images whose points and depth determine the pose of an image.

        The selected images are the local bundle of the best match, or the best matching images if
        ``wide``.
        """
        scores = self._scores
        if wide:
            score = scores[[image]].toarray()[0]
            matching = np.flatnonzero(self._scene.registered & (score > 0))
            order = np.argsort(-score[matching], kind="stable")
            references = matching[order[:NUM_WIDE_REFERENCES]].tolist()
        else:
            references = find_local_bundle(self._scene, best_match, scores)
        excluded = self._history.excluded_references.get(image, ())
        return [k for k in references if k not in excluded]

    def _would_fail_again(self, image: int, references: list[int]) -> bool:
        """Return whether an attempt to register an image would repeat its last failed attempt."""
        if not self._history.is_exhausted(image, references):
            return False
        best = self._history.get_last_pose(image)
        return best is None or self._thresholds.check_support(best) is not None

    def _estimate_poses(
        self, references: list[int], correspondences: PoseCorrespondences
    ) -> list[ScoredPose]:
        """Estimate poses of an image, best first, and add the best pose of the last attempt."""
        history = self._history
        image, poses = correspondences.image, []
        last_pose = history.get_last_pose(image)
        if last_pose:
            hypothesis = last_pose.hypothesis
            if not self._scene.has_free_focal(image):
                hypothesis = hypothesis._replace(focal_px=None)
            poses.append(self._pose_estimator.score_pose(correspondences, hypothesis))
        search = not history.is_exhausted(image, references)
        if search:
            attempt = history.count_searches(image)
            poses += self._pose_estimator.estimate_poses(correspondences, attempt=attempt)
        poses = select_distinct_poses(poses)
        history.record_attempt(image, references, poses[0] if poses else None, searched=search)
        return poses

    def _register_image(self, image: int, references: list[int]) -> Reason | None:
        """Register an image with the first of its estimated poses that passes verification.

        Args:
            image: Index of the image to register.
            references: Registered images whose matches determine the pose of the image.

        Returns:
            None if the image is registered, else the rejection reason of the image, with the scene
            unchanged.
        """
        scene = self._scene
        with self._event_log.timed("registration"):
            correspondences = find_correspondences(
                scene, image, references, self._options.registration
            )
            num_matches = int(correspondences.max_frame_weight(scene))
            if num_matches < self._thresholds.min_inliers:
                return ImageReason.TOO_FEW_POINTS.because(
                    num_matches=num_matches, min_matches=self._thresholds.min_inliers
                )
            poses = self._estimate_poses(references, correspondences)
        before = scene.snapshot(), self._refiner.noise
        reason: Reason | None = ImageReason.NO_POSE.because()
        verified: list[tuple[int, tuple[Snapshot, DepthNoise]]] = []
        for pose in poses:
            reason = self._thresholds.check_support(pose)
            reason = reason or self._history.get_rejection(image, pose)
            if reason is None:
                reason = self._extend_model(image, pose, correspondences)
                if reason is None:
                    if len(scene.rigs.images_of(image)) == 1:
                        return None
                    num_explained = int(np.count_nonzero(scene.explained_edges()))
                    verified.append((num_explained, (scene.snapshot(), self._refiner.noise)))
                else:
                    self._history.reject_pose(image, pose, reason)
                self._restore(before)
        if verified:
            _, state = max(verified, key=lambda candidate: candidate[0])
            self._restore(state)
            return None
        return reason

    def _restore(self, state: tuple[Snapshot, DepthNoise]) -> None:
        """Restore the scene and the noise of depth before or after the registration of an image."""
        snapshot, self._refiner.noise = state
        self._scene.restore(snapshot)

    def _extend_model(
        self, image: int, pose: ScoredPose, correspondences: PoseCorrespondences
    ) -> Reason | None:
        """Register an image with a pose, triangulate, refine locally and check depth consistency.

        Returns:
            None if the pose passes verification, else the rejection reason. The caller restores the
            scene of a rejected pose.
        """
        scene, options = self._scene, self._options
        with self._event_log.timed("local refinement"):
            scene.register(image, pose.rotation, pose.translation, pose.focal_px)
            members = scene.rigs.images_of(image)
            for member in members:
                triangulate_image(scene, member, options.triangulation)
            _, *neighbors = find_local_bundle(scene, image, self._scores)
            neighbors = [neighbor for neighbor in neighbors if neighbor not in members[1:]]
            for member in members:
                self._refiner.estimate_scale(member, neighbors)
            loss_factor = options.refinement.first_reprojection_scale
            self._refiner.adjust([image], local=True, reprojection_scale=loss_factor)
            filter_points(scene, options.triangulation, members)
            if image in find_lost_images(scene):
                return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
            for member in members:
                self._refiner.estimate_scale(member, neighbors)
            self._refiner.integrate(members)
        reason = self._maintenance.check_depth(image, options.consistency.max_violations)
        if reason:
            self._exclude_references(pose, correspondences)
            return reason
        with self._event_log.timed("local refinement"):
            self._refiner.refine_locally(image)
        lost = find_lost_images(scene)
        if image in lost:
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        self._maintenance.deregister(lost, ImageReason.LOST_POINTS.because(step="local-refinement"))
        return None

    def _exclude_references(self, pose: ScoredPose, correspondences: PoseCorrespondences) -> None:
        """Exclude reference frames whose matches support a pose that depth contradicts."""
        scene, options = self._scene, self._options.registration
        new_images = scene.rigs.images_of(correspondences.image)
        frames = correspondences.frames(scene)
        for frame in map(int, np.unique(frames)):
            of_frame = correspondences.select(frames == frame)
            scored = self._pose_estimator.score_pose(of_frame, pose.hypothesis)
            if scored.inlier_ratio >= options.min_pose_inlier_ratio:
                self._history.exclude(new_images, scene.rigs.images_of(frame))
