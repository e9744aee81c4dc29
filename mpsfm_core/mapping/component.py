"""Initialization, incremental registration and final refinement of one connected component."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.consistency.misregistration import Misregistration, detect_misregistrations
from mpsfm_core.mapping.consistency.pair_consistency import PairConsistencyCheck
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.incremental_registration import IncrementalRegistration
from mpsfm_core.mapping.initialization.camera_splitting import find_deviating_focals
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
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks, triangulate_image

_log = logging.getLogger(__name__)

MAX_INITIAL_VIOLATIONS = 0.03
"""Share of pixels with contradicting depth above which an initial pair is rejected, 0.6 times the
option ``max_violations``. [reference]"""
MAX_FINAL_VIOLATIONS = 0.08
"""Share of pixels with contradicting depth above which the final check deregisters an image, larger
than in registration because other images depend on the image. [tuned: benchmarks.symmetry]"""

_WITHOUT_POINTS = {
    True: "the scale of their depth is unknown; check that the poses and the images match",
    False: "the mapper starts without these poses, in another world",
}


def do_nothing() -> None:
    """Do nothing, as the default of optional callback arguments."""


class Component:
    """A connected set of images, from its initialization to its final refinement.

    Attributes:
        maintenance: Object that refines the component, checks depth and deregisters images.
        registration: Object that registers further images into the component.
        scene: Camera poses, 3D points and depth maps of the component.
        refiner: Object that runs bundle adjustment and depth integration.
    """

    def __init__(
        self,
        problem: MappingProblem,
        options: MapperOptions,
        pair_selector: InitialPairSelector,
        event_log: EventLog,
    ) -> None:
        self.maintenance = ModelMaintenance(problem, options, event_log)
        self.scene, self.refiner = self.maintenance.scene, self.maintenance.refiner
        self._options, self._pair_selector, self._event_log = options, pair_selector, event_log
        self._pose_estimator = AbsolutePoseEstimator(self.scene, self.refiner, options)
        self.registration = IncrementalRegistration(self.maintenance, self._pose_estimator)

    @property
    def size(self) -> int:
        """Number of registered images."""
        return self.maintenance.size

    def compute_pair_weights(self, unregistered: Bool) -> Float64:
        """Weight the match scores (p,) of the pairs of unregistered images by depth checks.

        The scene must not have registered images.
        """
        # all mapper runs use the same random seed to check pairs, so that relative poses do not
        # differ
        options = self._options.model_copy(update={"seed": 0})
        pose_estimator = AbsolutePoseEstimator(self.scene, self.refiner, options)
        check = PairConsistencyCheck(pose_estimator, options)
        return check.compute_pair_weights(self.maintenance.problem, unregistered)

    def initialize_from_known_poses(self, unregistered: Bool) -> bool:
        """Register all unregistered images with a known input pose.

        Returns:
            False if fewer than two images with known poses observe enough points.
        """
        images = self.maintenance.problem.images
        poses = {int(i): images[i].known_pose for i in np.flatnonzero(unregistered)}
        known = {image: pose for image, pose in poses.items() if pose is not None}
        if len(known) < 2:
            return False
        scene, options = self.scene, self._options
        self._set_rig_scale(np.array(list(known)), np.array([t for _, t in known.values()]))
        for image, pose in known.items():
            scene.register(image, *pose)
        is_fixed = options.known_poses == "fixed"
        self.refiner.fixed[scene.rigs.complete(list(known))] = is_fixed
        complete_and_merge_tracks(scene, options.triangulation, create=True)
        self.refiner.estimate_scales(list(known))
        if not len(scene.tracks):
            _log.warning("images with known poses share no points: %s", _WITHOUT_POINTS[is_fixed])
        self.maintenance.refine_globally()
        if self.size < 2:
            return False
        for image in self._first_images():
            self.maintenance.confirm(image)
        return True

    def initialize_from_model(self, model: Reconstruction, compared: Sequence[Int64]) -> bool:
        """Register the images of a joined reconstruction, and complete tracks across its parts.

        The depth maps of the parts are kept. Depth is checked between images of different parts.

        Args:
            model: Joined reconstruction.
            compared: Indices of the images of each part, whose depth was compared with each other.

        Returns:
            False if fewer than two images observe enough points.
        """
        self.scene.resume(model, refined_map_width=self._options.refinement.map_width)
        self.refiner.adapts_reprojection_loss = True
        self.refiner.keeps_depth_map[self.scene.registered_images()] = True
        self.maintenance.refine_globally()
        if self.refiner.can_refine_focals():
            # each part has estimated another focal length, so poses and points were distorted
            self.refiner.keeps_depth_map[:] = False
            self.maintenance.refine_globally()
        self.maintenance.check_all_images(MAX_FINAL_VIOLATIONS, "final-check", compared)
        if self.size < 2:
            return False
        for image in self._first_images():
            self.maintenance.confirm(image)
        return True

    def initialize_globally(self, unregistered: Bool) -> bool:
        """Register all well connected images together (motion averaging).

        Images whose depth contradicts other images are deregistered. The globally averaged poses
        are kept if both keypoints of enough matches observe the same 3D point (option
        ``enough_explained``).

        Returns:
            False if the global initialization is rejected, which leaves no image registered.
        """
        before = self.scene.snapshot()
        with self._event_log.timed("global initialization"):
            poses = estimate_global_poses(self.scene, unregistered)
            if poses is None:
                return False
            self._register_global_poses(poses)
        self.refiner.adapts_reprojection_loss = True
        self.maintenance.refine_globally()
        if self.refiner.can_refine_focals():
            # poses that a wrong focal length distorted need a second refinement with the refined
            # focal length
            self.maintenance.refine_globally()
        max_violations = self._options.consistency.max_violations
        self.maintenance.check_all_images(max_violations, "global-initialization")
        if self._explained_ratio(poses.images) < self._options.enough_explained:
            self.maintenance.clear(before)
            return False
        for image in self._first_images():
            self.maintenance.confirm(image)
        return True

    def _register_global_poses(self, poses: GlobalPoses) -> None:
        """Register images with globally averaged poses, triangulate tracks and refine once."""
        scene, options = self.scene, self._options
        images = [int(image) for image in poses.images]
        self._set_rig_scale(poses.images, poses.translations)
        for image, rotation, translation, scale in zip(
            images, poses.rotations, poses.translations, poses.scales, strict=True
        ):
            scene.register(image, rotation, translation)
            scene.maps[image].set_scale(float(scale))
        images = scene.rigs.complete(images)
        for image in images:
            triangulate_image(scene, image, options.triangulation)
        for image in images[len(poses.images) :]:
            self.refiner.estimate_scale(image, [])
        loss_factor = options.refinement.first_reprojection_scale
        self.refiner.adjust(images, rough=True, reprojection_scale=loss_factor)
        filter_points(scene, options.triangulation)

    def _first_images(self) -> list[int]:
        """Return one registered image of each frame."""
        frames = self.scene.rigs.frame_of[self.scene.registered_images()]
        return [int(image) for image in np.unique(frames)]

    def _set_rig_scale(self, images: Int64, translations: Float64) -> None:
        """Set the scale of rigs to fit the poses of images, if a frame has a baseline."""
        scale = self.scene.rigs.measure_scale(images, translations)
        if scale is not None and scale > 0:
            self.scene.set_rig_scale(scale)

    def _explained_ratio(self, images: Int64) -> float:
        """Return the share of the summed match scores between frames that 3D points explain."""
        graph = self.scene.graph
        is_chosen = self.scene.mask(self.scene.rigs.complete(images.tolist()))[graph.image_of]
        is_between = is_chosen[graph.source] & is_chosen[graph.target] & ~self._within_frames()
        is_explained = is_between & self.scene.explained_edges()
        return float(graph.score[is_explained].sum() / max(graph.score[is_between].sum(), 1e-12))

    def initialize_from_pair(self, unregistered: Bool) -> bool:
        """Initialize from the best image pair, and relax thresholds until a pair is accepted.

        Returns:
            False if no image pair is accepted at the most relaxed thresholds.
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
        """Register an initial image pair, and return None, or the reason of its rejection."""
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
        """Register and refine an initial pair, and return None, or the reason of its rejection."""
        a, b = initial_pair.reference, initial_pair.image
        register_first_image(self.scene, a)
        pose = initial_pair.pose
        self.scene.register(b, pose.rotation, pose.translation, pose.focal_px)
        images = self.scene.rigs.complete([a, b])
        for image in images[1:]:
            triangulate_image(self.scene, image, self._options.triangulation)
        for image in images[1:]:
            self.refiner.estimate_scale(image, [])
        self.refiner.adjust(images)
        filter_points(self.scene, self._options.triangulation)
        if find_lost_images(self.scene):
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        for image in images:
            self.refiner.estimate_scale(image, [])
        self.refiner.integrate(images)
        self.refiner.adjust(images)
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
            candidates: (n,) bool mask of the images that may be registered.
            save_checkpoint: Function that is called after each image registration.
            wide: If registration with the local bundle of the best matching image fails, try the
                best matching images as references before the acceptance thresholds relax.
        """
        while self.registration.register_next_image(candidates, wide=wide):
            self.maintenance.refine_if_grown()
            save_checkpoint()

    def reregister_images(self, candidates: Bool) -> None:
        """Deregister misregistered images and register them with other reference images.

        The poses of re-registered images are kept if no image is lost and more matches observe
        common 3D points. Of sets that have most of their images in common, only the first is
        re-registered. If re-registration fails, images are deregistered that only one image pair
        connects to the model and several image pairs contradict. Images with a known pose stay
        registered, unless the known poses are only initial guesses.

        Args:
            candidates: (n,) bool mask of the images that may be registered.
        """
        tried: list[Misregistration] = []
        detections = self._detect_misregistrations()
        while detection := next((d for d in detections if d.differs_from(tried)), None):
            tried.append(detection)
            before, num_explained = self.maintenance.state(), self._count_explained_matches()
            self._deregister_misregistered(detection)
            self.register_images(candidates, wide=True)
            if not self._find_deregistered(before):
                self.maintenance.refine_globally()
            lost = self._find_deregistered(before)
            if not lost and self._count_explained_matches() > num_explained:
                detections = self._detect_misregistrations()
                continue
            self.maintenance.restore(before)
            for image in lost:
                self._event_log.registered(image, self.size)
            if detection.splits:
                self._split_off(detection)
                detections = self._detect_misregistrations()
            self._event_log.scene_changed(self.scene)

    def _split_off(self, detection: Misregistration) -> None:
        """Deregister images whose pose one image pair supports and several image pairs contradict.

        The deregistered images may form another component.
        """
        reason = ImageReason.SPLIT_OFF.because(num_matches=int(detection.margin))
        self.maintenance.deregister(list(detection.images), reason)
        reason = ImageReason.LOST_POINTS.because(step="component-split")
        self.maintenance.deregister(find_lost_images(self.scene), reason)
        self.maintenance.refine_globally()

    def _find_deregistered(self, before: ModelState) -> list[int]:
        """Return the images that were registered in an earlier model state and no longer are."""
        return [int(i) for i in np.flatnonzero(before.scene.registered & ~self.scene.registered)]

    def _deregister_misregistered(self, detection: Misregistration) -> None:
        """Deregister images and exclude the reference images that supported their wrong poses."""
        maintenance = self.maintenance
        reason = ImageReason.MISREGISTERED.because(num_matches=int(detection.margin))
        maintenance.deregister(list(detection.images), reason)
        reason = ImageReason.LOST_POINTS.because(step="re-registration")
        maintenance.deregister(find_lost_images(self.scene), reason)
        maintenance.history.clear()
        rigs = self.scene.rigs
        for image, reference in detection.supporting_pairs.tolist():
            maintenance.history.exclude(rigs.images_of(image), rigs.images_of(reference))

    def _detect_misregistrations(self) -> list[Misregistration]:
        """Detect misregistered images, except those whose known pose must not change.

        Only if no poses are contradicted, images with a wrong focal length are detected.
        """
        is_guess = self._options.known_poses == "guess"
        has_pose = np.array(
            [image.known_pose is not None for image in self.maintenance.problem.images]
        )
        detections = detect_misregistrations(self.scene, self._options.registration.min_inliers)
        detections = detections or self._detect_wrong_focals()
        return [d for d in detections if is_guess or not has_pose[list(d.images)].any()]

    def _detect_wrong_focals(self) -> list[Misregistration]:
        """Detect images with their own camera whose points support another focal length."""
        problem, options = self.maintenance.problem, self._options
        is_guessed = any(not image.focal_known for image in problem.images)
        if not is_guessed or not options.refinement.refine_focal or not self.size:
            return []
        focals = find_deviating_focals(
            problem, convert_scene(self.scene), options.registration, options.seed, is_shared=False
        )
        no_pairs = np.zeros((0, 2), dtype=np.int64)
        return [Misregistration((image,), no_pairs, 0) for image in focals]

    def _count_explained_matches(self) -> int:
        """Count the matches between frames whose keypoints observe the same 3D point."""
        return int(np.count_nonzero(self.scene.explained_edges() & ~self._within_frames()))

    def _within_frames(self) -> Bool:
        """Return a bool mask (e,) of the matches between images of the same frame of a rig."""
        frame_of = self.scene.rigs.frame_of[self.scene.graph.image_of]
        within: Bool = frame_of[self.scene.graph.source] == frame_of[self.scene.graph.target]
        return within

    def finalize(self) -> None:
        """Refine all images and guessed cameras a last time, and repeat the depth check.

        The refinement is skipped if the model has not changed since the last refinement.
        """
        refiner = self.refiner
        is_calibrated = refiner.calibrates_with_long_tracks or not refiner.can_refine_focals()
        if self.maintenance.is_checked and is_calibrated:
            return
        refiner.calibrates_with_long_tracks = True
        if not (self.maintenance.is_refined and is_calibrated):
            self.maintenance.refine_globally()
        consistency = self._options.consistency
        if consistency.enabled and consistency.check_at_end:
            self.maintenance.check_all_images(MAX_FINAL_VIOLATIONS, "final-check")
