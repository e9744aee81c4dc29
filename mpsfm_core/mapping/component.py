"""One connected component: initialization, incremental registration and final refinement."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingProblem, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.consistency.misregistration import Misregistration, detect_misregistrations
from mpsfm_core.mapping.consistency.pair_consistency import PairConsistencyCheck
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.initialization.global_initialization import (
    GlobalPoses,
    estimate_global_poses,
)
from mpsfm_core.mapping.initialization.initial_pair import (
    InitialPair,
    InitialPairSelector,
    register_first_image,
)
from mpsfm_core.mapping.model_maintenance import ModelMaintenance, ModelState
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.filtering import filter_points, find_lost_images
from mpsfm_core.mapping.registration.incremental_registration import IncrementalRegistration
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks, triangulate_image

_log = logging.getLogger(__name__)

MAX_INITIAL_VIOLATIONS = 0.03
"""Share of contradicting pixels above which an initial pair is rejected; 0.6 of
``max_violations``, as in the reference. [reference]"""
MAX_FINAL_VIOLATIONS = 0.08
"""The same in the final check. Images that were verified before need clearer evidence, since
others depend on them. [tuned: benchmarks.symmetry]"""

_WITHOUT_POINTS = {
    True: "the scale of their depth is unknown; check that the poses and the images match",
    False: "the mapper starts without these poses, in another world",
}


def do_nothing() -> None:
    """Default of optional callbacks."""


class Component:
    """A connected set of images, from its initialization to its final refinement.

    Attributes:
        maintenance: Refinement, depth checks and deregistration.
        registration: Registration of further images.
        scene: Poses, points and depth maps.
        refiner: Bundle adjustment and depth integration.
    """

    maintenance_type: type[ModelMaintenance] = ModelMaintenance
    registration_type: type[IncrementalRegistration] = IncrementalRegistration

    def __init__(
        self,
        problem: MappingProblem,
        options: MapperOptions,
        pair_selector: InitialPairSelector,
        event_log: EventLog,
    ) -> None:
        self.maintenance = self.maintenance_type(problem, options, event_log)
        self.scene, self.refiner = self.maintenance.scene, self.maintenance.refiner
        self._options, self._pair_selector, self._event_log = options, pair_selector, event_log
        self._pose_estimator = AbsolutePoseEstimator(self.scene, self.refiner, options)
        self.registration = self.registration_type(self.maintenance, self._pose_estimator)

    @property
    def size(self) -> int:
        """Number of registered images."""
        return self.maintenance.size

    def reweight_pairs(self, unregistered: Bool) -> MappingProblem:
        """Return the problem with the pairs of unregistered images reweighted by depth.

        The scene must have no registered image.
        """
        # all runs use the same seed here, so that they compare pairs with the same poses
        options = self._options.model_copy(update={"seed": 0})
        pose_estimator = AbsolutePoseEstimator(self.scene, self.refiner, options)
        check = PairConsistencyCheck(pose_estimator, options)
        return check.reweight_pairs(self.maintenance.problem, unregistered)

    def initialize_from_known_poses(self, unregistered: Bool) -> bool:
        """Register all unregistered images that came with a pose.

        Returns:
            False if fewer than two images keep enough points.
        """
        images = self.maintenance.problem.images
        poses = {int(i): images[i].known_pose for i in np.flatnonzero(unregistered)}
        known = {image: pose for image, pose in poses.items() if pose is not None}
        if len(known) < 2:
            return False
        scene, options = self.scene, self._options
        for image, pose in known.items():
            scene.register(image, *pose)
        is_fixed = options.known_poses == "fixed"
        self.refiner.fixed[list(known)] = is_fixed
        complete_and_merge_tracks(scene, options.triangulation, create=True)
        self.refiner.estimate_scales(list(known))
        if not len(scene.tracks):
            _log.warning("images with known poses share no points: %s", _WITHOUT_POINTS[is_fixed])
        self.maintenance.refine_globally()
        if self.size < 2:
            return False
        for image in map(int, scene.registered_images()):
            self.maintenance.confirm(image)
        return True

    def initialize_globally(self, unregistered: Bool) -> bool:
        """Register all well connected images together (motion averaging).

        The result is kept if, without images whose depth contradicts others, the points explain
        ``enough_explained`` of the matches between the registered images.

        Returns:
            False if the initialization is rejected; the scene is then empty.
        """
        before = self.scene.snapshot()
        with self._event_log.timed("global start"):
            poses = estimate_global_poses(self.scene, unregistered)
            if poses is None:
                return False
            self._register_global_poses(poses)
        self.refiner.adapts_reprojection_loss = True
        self.maintenance.refine_globally()
        if self.refiner.can_refine_focals():
            # the first refinement started from poses that a wrong focal length had bent
            self.maintenance.refine_globally()
        max_violations = self._options.consistency.max_violations
        self.maintenance.check_all_images(max_violations, "global-initialization")
        if self._explained_ratio(poses.images) < self._options.enough_explained:
            self.maintenance.clear(before)
            return False
        for image in map(int, self.scene.registered_images()):
            self.maintenance.confirm(image)
        return True

    def _register_global_poses(self, poses: GlobalPoses) -> None:
        """Register images with global poses, triangulate and refine once."""
        scene, options = self.scene, self._options
        images = [int(image) for image in poses.images]
        for image, rotation, translation, scale in zip(
            images, poses.rotations, poses.translations, poses.scales, strict=True
        ):
            scene.register(image, rotation, translation)
            scene.maps[image].set_scale(float(scale))
        for image in images:
            triangulate_image(scene, image, options.triangulation)
        loss_factor = options.refinement.first_reprojection_scale
        self.refiner.adjust(images, reprojection_scale=loss_factor)
        filter_points(scene, options.triangulation)

    def _explained_ratio(self, images: Int64) -> float:
        """Return the share of the match scores between images that points explain."""
        graph = self.scene.graph
        is_chosen = self.scene.mask(images)[graph.image_of]
        is_between = is_chosen[graph.source] & is_chosen[graph.target]
        is_explained = is_between & self.scene.explained_edges()
        return float(graph.score[is_explained].sum() / max(graph.score[is_between].sum(), 1e-12))

    def initialize_from_pair(self, unregistered: Bool) -> bool:
        """Initialize from the best pair of unregistered images; relax thresholds until one works.

        Returns:
            False if no pair works at the most relaxed thresholds.
        """
        with self._event_log.timed("initialization"):
            pairs = self._pair_selector.rank_pairs(self._pose_estimator, unregistered)
        snapshot = self.scene.snapshot()
        while True:
            for pair in pairs:
                with self._event_log.timed("initialization"):
                    reason = self._try_pair(pair)
                if reason is None:
                    self.maintenance.thresholds.reset()
                    self.maintenance.confirm(pair.image_a)
                    self.maintenance.confirm(pair.image_b)
                    self.maintenance.refine_globally()
                    return True
                self._event_log.pair_rejected(pair, reason)
                self.scene.restore(snapshot)
            if not pairs or not self.maintenance.thresholds.relax():
                return False

    def _try_pair(self, pair: VerifiedPair) -> Reason | None:
        """Register a pair; None on success, else the reason, which is recorded if it is final."""
        initial_pair = self._pair_selector.estimate_pair(self._pose_estimator, pair)
        if isinstance(initial_pair, Reason):
            return initial_pair
        reason = self.maintenance.thresholds.check_support(initial_pair.pose)
        if reason is None:
            reason = self._register_pair(initial_pair)
            if reason:
                self._pair_selector.reject_pair(pair, reason)
        return reason

    def _register_pair(self, initial_pair: InitialPair) -> Reason | None:
        """Register both images, triangulate, refine and check depth; None or why that fails."""
        a, b = initial_pair.reference, initial_pair.image
        register_first_image(self.scene, a)
        pose = initial_pair.pose
        self.scene.register(b, pose.rotation, pose.translation, pose.focal_px)
        triangulate_image(self.scene, b, self._options.triangulation)
        self.refiner.estimate_scale(b, [])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if find_lost_images(self.scene):
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        self.refiner.estimate_scale(a, [])
        self.refiner.estimate_scale(b, [])
        self.refiner.integrate([a, b])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if find_lost_images(self.scene):
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        return self.maintenance.check_depth(b, MAX_INITIAL_VIOLATIONS)

    def register_images(
        self,
        candidates: Bool,
        save_checkpoint: Callable[[], None] = do_nothing,
        *,
        wide: bool = False,
    ) -> None:
        """Register images until no candidate can be registered.

        Args:
            candidates: (n,) bool, images that may be registered.
            save_checkpoint: Called after each registration.
            wide: If an image fails with its usual references, also use the images that match it
                best, before the thresholds relax.
        """
        while self.registration.register_next_image(candidates, wide=wide):
            self.maintenance.refine_if_grown()
            save_checkpoint()

    def reregister_images(self, candidates: Bool) -> None:
        """Deregister misregistered images and register them with other references.

        The change is kept if no image is lost, more matches are explained, and the images are no
        longer misregistered. Each set of images is tried once. If that fails, a group that one
        pair connects and several contradict is split off. Images with a known pose stay, unless
        that pose is only an initial guess.

        Args:
            candidates: (n,) bool, images that may be registered.
        """
        tried: set[tuple[int, ...]] = set()
        detections = self._detect_misregistrations()
        while detection := next((d for d in detections if d.images not in tried), None):
            tried.add(detection.images)
            before, num_explained = self.maintenance.state(), self._count_explained_matches()
            self._deregister_misregistered(detection)
            self.register_images(candidates, wide=True)
            if not self._find_deregistered(before):
                self.maintenance.refine_globally()
            lost = self._find_deregistered(before)
            if not lost and self._count_explained_matches() > num_explained:
                remaining = self._detect_misregistrations()
                if all(other.images != detection.images for other in remaining):
                    detections = remaining
                    continue
            self.maintenance.restore(before)
            for image in lost:
                self._event_log.registered(image, self.size)
            if detection.splits:
                self._split_off(detection)
                detections = self._detect_misregistrations()
            self._event_log.scene_changed(self.scene)

    def _split_off(self, detection: Misregistration) -> None:
        """Deregister images that one pair connects and several contradict.

        They may form another component.
        """
        reason = ImageReason.SPLIT_OFF.because(num_matches=int(detection.margin))
        self.maintenance.deregister(list(detection.images), reason)
        reason = ImageReason.LOST_POINTS.because(step="component-split")
        self.maintenance.deregister(find_lost_images(self.scene), reason)
        self.maintenance.refine_globally()

    def _find_deregistered(self, before: ModelState) -> list[int]:
        """Return the images that were registered in an earlier state and are not now."""
        return [int(i) for i in np.flatnonzero(before.scene.registered & ~self.scene.registered)]

    def _deregister_misregistered(self, detection: Misregistration) -> None:
        """Deregister images and exclude the references that supported their wrong poses."""
        maintenance = self.maintenance
        reason = ImageReason.MISREGISTERED.because(num_matches=int(detection.margin))
        maintenance.deregister(list(detection.images), reason)
        reason = ImageReason.LOST_POINTS.because(step="re-registration")
        maintenance.deregister(find_lost_images(self.scene), reason)
        maintenance.history.clear()
        image, reference = detection.supporting_pairs.T
        maintenance.history.excluded_references[image, reference] = True

    def _detect_misregistrations(self) -> list[Misregistration]:
        """Detect misregistered images that may be moved."""
        is_guess = self._options.known_poses == "guess"
        has_pose = np.array(
            [image.known_pose is not None for image in self.maintenance.problem.images]
        )
        detections = detect_misregistrations(self.scene, self._options.registration.min_inliers)
        return [d for d in detections if is_guess or not has_pose[list(d.images)].any()]

    def _count_explained_matches(self) -> int:
        """Count the matches whose keypoints observe the same point."""
        return int(np.count_nonzero(self.scene.explained_edges()))

    def finalize(self) -> None:
        """Refine globally, check the depth of every image again, and refine as the options say."""
        if self.maintenance.is_checked:
            return
        self.maintenance.refine_globally()
        consistency = self._options.consistency
        if consistency.enabled and consistency.check_at_end:
            self.maintenance.check_all_images(MAX_FINAL_VIOLATIONS, "final-check")
        if self._options.refinement.final_robust:
            self.maintenance.refine_globally(final=True)
