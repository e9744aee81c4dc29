"""One connected group of images: its start, its growth, its end (paper, system overview)."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingProblem, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.consistency.misregistration import Misregistration, detect_misregistrations
from mpsfm_core.mapping.consistency.pair_consistency import PairConsistencyCheck
from mpsfm_core.mapping.event_log import Journal
from mpsfm_core.mapping.initialization.global_initialization import (
    GlobalPoses,
    estimate_global_poses,
)
from mpsfm_core.mapping.initialization.initial_pair import (
    InitialPair,
    InitialPairSelector,
    register_first_image,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.filtering import filter_points, lost_images
from mpsfm_core.mapping.refinement.maintenance import State, Upkeep
from mpsfm_core.mapping.registration.incremental_registration import IncrementalRegistration
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks, triangulate_image

_log = logging.getLogger(__name__)

_WITHOUT = {
    True: "the scale of their depth is unknown",
    False: "starting without these poses, in another world",
}


def nothing() -> None:
    """Nobody wants to know."""


class Group:
    """Images that hold together: started, grown image by image, and finished.

    ``starts``: first pairs, which all groups of a run share.
    """

    upkeep_type: type[Upkeep] = Upkeep
    growth_type: type[IncrementalRegistration] = IncrementalRegistration

    def __init__(
        self,
        problem: MappingProblem,
        options: MapperOptions,
        starts: InitialPairSelector,
        journal: Journal,
    ) -> None:
        self.upkeep = self.upkeep_type(problem, options, journal)
        self.scene, self.refiner = self.upkeep.scene, self.upkeep.refiner
        self._options, self._starts, self._journal = options, starts, journal
        self._search = AbsolutePoseEstimator(self.scene, self.refiner, options)
        self.growth = self.growth_type(self.upkeep, self._search)

    @property
    def size(self) -> int:
        """Number of registered images."""
        return self.upkeep.size

    def weighed_problem(self, left: Bool) -> MappingProblem:
        """The problem with pairs of the images that are left as far as depth allows them; for a
        group without images."""
        # which poses are tried is no matter of chance that runs should differ by
        options = self._options.model_copy(update={"seed": 0})
        search = AbsolutePoseEstimator(self.scene, self.refiner, options)
        return PairConsistencyCheck(search, options).reweight_pairs(self.upkeep.problem, left)

    def start_from_known_poses(self, left: Bool) -> bool:
        """Register all images that came with a pose; False when fewer than two hold together."""
        images = self.upkeep.problem.images
        poses = {int(i): images[i].known_pose for i in np.flatnonzero(left)}
        known = {image: pose for image, pose in poses.items() if pose is not None}
        if len(known) < 2:
            return False
        scene, options = self.scene, self._options
        for image, pose in known.items():
            scene.register(image, *pose)
        fixed = options.known_poses == "fixed"
        self.refiner.fixed[list(known)] = fixed
        complete_and_merge_tracks(scene, options.triangulation, create=True)
        self.refiner.scale_together(list(known))
        if not len(scene.tracks):
            _log.warning("images with known poses share no points: %s", _WITHOUT[fixed])
        self.upkeep.refine_globally()
        if self.size < 2:
            return False
        for image in map(int, scene.registered_images()):
            self.upkeep.accept(image)
        return True

    def start_from_all(self, left: Bool) -> bool:
        """Place all well connected images at once; False, and nothing done, unless that holds.

        It does where, without views that contradict others, the points explain as many of the
        matches of all as make other runs needless.
        """
        before = self.scene.snapshot()
        with self._journal.timed("global start"):
            placed = estimate_global_poses(self.scene, left)
            if placed is None:
                return False
            self._build(placed)
        self.refiner.clean_matches = True
        self.upkeep.refine_globally()
        if self.refiner.focal_is_stable():
            # the first time was around poses that a wrong focal length bent
            self.upkeep.refine_globally()
        limit = self._options.consistency.max_violations
        self.upkeep.check_all(limit, "global-initialization")
        if self._explained_share(placed.images) < self._options.enough_explained:
            self.upkeep.empty(before)
            return False
        for image in map(int, self.scene.registered_images()):
            self.upkeep.accept(image)
        return True

    def _build(self, placed: GlobalPoses) -> None:
        """Points and a first refinement of images that were placed at once."""
        scene, options = self.scene, self._options
        images = [int(image) for image in placed.images]
        for image, rotation, translation, scale in zip(
            images, placed.rotations, placed.translations, placed.scales, strict=True
        ):
            scene.register(image, rotation, translation)
            scene.maps[image].set_scale(float(scale))
        for image in images:
            triangulate_image(scene, image, options.triangulation)
        wide = options.refinement.first_reprojection_scale
        self.refiner.adjust(images, reprojection_scale=wide)
        filter_points(scene, options.triangulation)

    def _explained_share(self, images: Int64) -> float:
        """Of the matches between some images, by score, whose keypoints see the same point."""
        graph = self.scene.graph
        chosen = self.scene.mask(images)[graph.image_of]
        between = chosen[graph.source] & chosen[graph.target]
        same = between & self.scene.explained_edges()
        return float(graph.score[same].sum() / max(graph.score[between].sum(), 1e-12))

    def start_from_pair(self, left: Bool) -> bool:
        """Find the first pair among the images that are left and refine it."""
        with self._journal.timed("initialization"):
            pairs = self._starts.rank_pairs(self._search, left)
        snapshot = self.scene.snapshot()
        while True:
            for pair in pairs:
                with self._journal.timed("initialization"):
                    reason = self._try_pair(pair)
                if reason is None:
                    self.upkeep.thresholds.reset()
                    self.upkeep.accept(pair.image_a)
                    self.upkeep.accept(pair.image_b)
                    self.upkeep.refine_globally()
                    return True
                self._journal.pair_rejected(pair, reason)
                self.scene.restore(snapshot)
            if not pairs or not self.upkeep.thresholds.relax():
                return False

    def _try_pair(self, pair: VerifiedPair) -> Reason | None:
        """InitialPair with a pair; None, or why it cannot be the first (remembered if that is final)."""
        start = self._starts.estimate_pair(self._search, pair)
        if isinstance(start, Reason):
            return start
        reason = self.upkeep.thresholds.check_support(start.pose)
        if reason is None:
            reason = self._grow_start(start)
            if reason:
                self._starts.reject_pair(pair, reason)
        return reason

    def _grow_start(self, start: InitialPair) -> Reason | None:
        """Refine the first two images and their points; None, or why they are rejected."""
        a, b = start.reference, start.image
        register_first_image(self.scene, a)
        self.scene.register(b, start.pose.rotation, start.pose.translation)
        triangulate_image(self.scene, b, self._options.triangulation)
        self.refiner.estimate_scale(b, [])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if lost_images(self.scene):
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        self.refiner.estimate_scale(a, [])
        self.refiner.estimate_scale(b, [])
        self.refiner.integrate([a, b])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if lost_images(self.scene):
            return ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        return self.upkeep.contradiction(b, self._options.consistency.max_violations_initial)

    def grow(
        self, available: Bool, paused: Callable[[], None] = nothing, *, wide: bool = False
    ) -> None:
        """Register images until none of the available ones can be; ``paused`` after each.

        ``wide``: also beside those that they match best, before thresholds give way.
        """
        while self.growth.register_next_image(available, wide=wide):
            self.upkeep.refresh()
            paused()

    def reseat(self, available: Bool) -> None:
        """Take out images that matches hold weakly, and register them elsewhere.

        That counts if no image is lost, more matches than before see common points, and no others
        want them away; each such group of images is taken out once. Images that came with a pose
        stay, unless that is a guess.
        """
        tried: set[tuple[int, ...]] = set()
        holds = self._weak_holds()
        while hold := next((h for h in holds if h.images not in tried), None):
            tried.add(hold.images)
            before, explained = self.upkeep.state(), self._num_explained()
            self._take_out(hold)
            self.grow(available, wide=True)
            if not self._lost_since(before):
                self.upkeep.refine_globally()
            lost = self._lost_since(before)
            if not lost and self._num_explained() > explained:
                left = self._weak_holds()
                if all(other.images != hold.images for other in left):
                    holds = left
                    continue
            self.upkeep.restore(before)
            for image in lost:
                self._journal.registered(image, self.size)
            self._journal.scene_changed(self.scene)

    def _lost_since(self, before: State) -> list[int]:
        """Images that were registered then and are not now."""
        return [int(i) for i in np.flatnonzero(before.scene.registered & ~self.scene.registered)]

    def _take_out(self, hold: Misregistration) -> None:
        """Take weakly held images out, not to be posed again beside those that hold them."""
        upkeep = self.upkeep
        reason = ImageReason.MISREGISTERED.because(num_matches=int(hold.margin))
        upkeep.drop(list(hold.images), reason)
        reason = ImageReason.LOST_POINTS.because(step="re-registration")
        upkeep.drop(lost_images(self.scene), reason)
        upkeep.history.clear()
        upkeep.history.excluded_references[hold.links[:, 0], hold.links[:, 1]] = True

    def _weak_holds(self) -> list[Misregistration]:
        """Weakly held images that may be taken out."""
        guess = self._options.known_poses == "guess"
        stays = np.array([image.known_pose is not None for image in self.upkeep.problem.images])
        holds = detect_misregistrations(self.scene, self._options.registration.min_inliers)
        return [hold for hold in holds if guess or not stays[list(hold.images)].any()]

    def _num_explained(self) -> int:
        """Matches of which both keypoints see the same point."""
        return int(np.count_nonzero(self.scene.explained_edges()))

    def finish(self) -> None:
        """Last refinements, and the depth check once more for every image."""
        if self.upkeep.all_checked:
            return
        self.upkeep.refine_globally()
        consistency = self._options.consistency
        if consistency.enabled and consistency.check_at_end:
            self.upkeep.check_all(consistency.max_violations_final, "final-check")
        if self._options.refinement.final_robust:
            self.upkeep.refine_globally(final=True)
