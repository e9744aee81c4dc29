"""One connected group of images: its start, its growth, its end (paper, system overview)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from mpsfm_core.data import Bool, Int64, MappingProblem, VerifiedPair
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.attempts import Attempts
from mpsfm_core.mapping.correspondences import Correspondences, correspondences
from mpsfm_core.mapping.depth_consistency import DepthCheck
from mpsfm_core.mapping.failure_ladder import FailureLadder
from mpsfm_core.mapping.filtering import disconnected_images, filter_points, lost_images
from mpsfm_core.mapping.global_start import Placement, place_all
from mpsfm_core.mapping.initialization import Start, Starts, place_first
from mpsfm_core.mapping.journal import Journal
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.pose_support import AbsolutePose, rate_pose
from mpsfm_core.mapping.refinement import Refiner
from mpsfm_core.mapping.registration import PoseSearch
from mpsfm_core.mapping.triangulation import complete_and_merge, triangulate_image
from mpsfm_core.mapping.view_selection import local_bundle, pair_score_matrix, rank_next_images
from mpsfm_core.mapping.weak_holds import WeakHold, pair_matches, weak_holds
from mpsfm_core.scene.scene import Scene, Snapshot

_log = logging.getLogger(__name__)

WIDE_REFERENCES = 10
"""Images beside which one is posed that matches want elsewhere (ours; 5 hold fewer images)."""
JUMP_DEG = 3.0
"""A camera that turns more in a global refinement may have found a wrong minimum (ours)."""
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

    def __init__(
        self, problem: MappingProblem, options: MapperOptions, starts: Starts, journal: Journal
    ) -> None:
        self.scene = Scene(problem, weigh_by_score=options.weigh_by_score)
        self._scores = pair_score_matrix(self.scene, options.registration.next_view)
        self.refiner = Refiner(self.scene, options, self._scores)
        self.attempts = Attempts(self.scene.num_images, options.registration)
        self._problem, self._options = problem, options
        self._starts, self.journal = starts, journal
        self._search = PoseSearch(self.scene, self.refiner, options)
        self._check = DepthCheck(self.scene, options.consistency)
        self._ladder = FailureLadder(options.registration)
        self._last_size = (0, 0)
        self._checked: Bool = np.zeros(self.scene.num_images, dtype=np.bool_)

    @property
    def size(self) -> int:
        """Number of registered images."""
        return int(self.scene.registered.sum())

    def start_from_known_poses(self, left: Bool) -> bool:
        """Register all images that came with a pose; False when fewer than two hold together."""
        images = self._problem.images
        poses = {int(i): images[i].known_pose for i in np.flatnonzero(left)}
        known = {image: pose for image, pose in poses.items() if pose is not None}
        if len(known) < 2:
            return False
        scene, options = self.scene, self._options
        for image, pose in known.items():
            scene.register(image, *pose)
        fixed = options.known_poses == "fixed"
        self.refiner.fixed[list(known)] = fixed
        complete_and_merge(scene, options.triangulation, create=True)
        self.refiner.scale_together(list(known))
        if not len(scene.tracks):
            _log.warning("images with known poses share no points: %s", _WITHOUT[fixed])
        self._refine_globally()
        if self.size < 2:
            return False
        for image in map(int, scene.registered_images()):
            self._accept(image)
        return True

    def start_from_all(self, left: Bool) -> bool:
        """Place all well connected images at once; False, and nothing done, unless that holds.

        It does where, without views that contradict others, the points explain as many of the
        matches of all as make other runs needless.
        """
        before = self.scene.snapshot()
        with self.journal.timed("global start"):
            placed = place_all(self.scene, left)
            if placed is None:
                return False
            self._build(placed)
        self.refiner.clean_matches = True
        self._refine_globally()
        if self.refiner.focal_is_stable():
            self._refine_globally()  # the first time around poses that a wrong focal length bent
        self._check_all(self._options.consistency.max_violations, "with all images placed at once")
        if self._explained_share(placed.images) < self._options.enough_explained:
            self.scene.restore(before)
            self.refiner.forget_all()
            self._checked[:] = False
            self._last_size = (0, 0)
            return False
        for image in map(int, self.scene.registered_images()):
            self._accept(image)
        return True

    def _build(self, placed: Placement) -> None:
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
        with self.journal.timed("initialization"):
            pairs = self._starts.ranked(self._search, left)
        snapshot = self.scene.snapshot()
        while True:
            for pair in pairs:
                with self.journal.timed("initialization"):
                    reason = self._try_pair(pair)
                if reason is None:
                    self._ladder.reset()
                    self._accept(pair.image_a)
                    self._accept(pair.image_b)
                    self._refine_globally()
                    return True
                self.journal.pair_rejected(pair, reason)
                self.scene.restore(snapshot)
            if not pairs or not self._ladder.relax():
                return False

    def grow(
        self, available: Bool, paused: Callable[[], None] = nothing, *, wide: bool = False
    ) -> None:
        """Register images until none of the available ones can be; ``paused`` after each.

        ``wide``: also beside those that they match best, before thresholds give way.
        """
        while self._register_next(available, wide=wide):
            if self._grown():
                self._refine_globally()
            paused()

    def reseat(self, available: Bool) -> None:
        """Take out images that matches hold weakly, and register them elsewhere.

        That counts if no image is lost, more matches tie them to the rest then, and no others want
        them away; each such group of images is taken out once. Images that came with a pose stay,
        unless that is a guess.
        """
        tried: set[tuple[int, ...]] = set()
        while hold := next((h for h in self._weak_holds() if h.images not in tried), None):
            tried.add(hold.images)
            before, checked, tied = self.scene.snapshot(), self._checked.copy(), self._tied(hold)
            measured = self.refiner.noise, self.refiner.loss_scale
            self._drop(list(hold.images), f"{hold.margin} more matches want it elsewhere")
            self._drop(lost_images(self.scene), "lost its points when another image was taken out")
            self.attempts.forget()
            self.attempts.refuted[hold.links[:, 0], hold.links[:, 1]] = True
            self.grow(available, wide=True)
            self._refine_globally()
            lost = np.flatnonzero(before.registered & ~self.scene.registered)
            still = any(other.images == hold.images for other in self._weak_holds())
            if len(lost) or still or self._tied(hold) <= tied:
                self.scene.restore(before)
                self._checked = checked
                self.refiner.noise, self.refiner.loss_scale = measured
                self.attempts.forget()
                for image in map(int, lost):
                    self.journal.registered(image, self.size)
                self.journal.scene_changed(self.scene)

    def _weak_holds(self) -> list[WeakHold]:
        """Weakly held images that may be taken out."""
        guess = self._options.known_poses == "guess"
        stays = np.array([image.known_pose is not None for image in self._problem.images])
        holds = weak_holds(self.scene, self._options.registration.min_inliers)
        return [hold for hold in holds if guess or not stays[list(hold.images)].any()]

    def _tied(self, hold: WeakHold) -> int:
        """Matches that see common points in some images and in the rest."""
        _, explained = pair_matches(self.scene)
        inside = self.scene.mask(list(hold.images))
        return int(explained[np.ix_(inside, ~inside)].sum())

    def finish(self) -> None:
        """Last refinements, and the depth check once more for every image."""
        if self._checked[self.scene.registered].all():
            return
        self._refine_globally()
        consistency = self._options.consistency
        if consistency.enabled and consistency.check_at_end:
            self._check_all(consistency.max_violations_final, "at the end")
        if self._options.refinement.final_robust:
            self._refine_globally(final=True)

    def _try_pair(self, pair: VerifiedPair) -> str | None:
        """Start with a pair; None, or why it cannot be the first (remembered if that is final)."""
        start = self._starts.find(self._search, pair)
        if isinstance(start, str):
            return start
        reason = self._ladder.objection(start.pose)
        if reason is None:
            reason = self._grow_start(start)
            if reason:
                self._starts.refuse(pair, reason)
        return reason

    def _grow_start(self, start: Start) -> str | None:
        """Refine the first two images and their points; None, or why they are rejected."""
        a, b = start.reference, start.image
        place_first(self.scene, a)
        self.scene.register(b, start.pose.rotation, start.pose.translation)
        triangulate_image(self.scene, b, self._options.triangulation)
        self.refiner.estimate_scale(b, [])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if lost_images(self.scene):
            return "too few points are left after refinement"
        self.refiner.estimate_scale(a, [])
        self.refiner.estimate_scale(b, [])
        self.refiner.integrate([a, b])
        self.refiner.adjust([a, b])
        filter_points(self.scene, self._options.triangulation)
        if lost_images(self.scene):
            return "too few points are left after refinement"
        return self._contradiction(b, self._options.consistency.max_violations_initial)

    def _register_next(self, available: Bool, *, wide: bool = False) -> bool:
        """Register one more image, relaxing step by step; False when none can be."""
        options = self._options.registration
        while True:
            trusted = np.where(self.attempts.refuted, 0, self._scores)
            ranked = rank_next_images(self.scene, trusted, available, options)
            if self._register_one_of(ranked, wide=False):
                return True
            if self._displace():
                continue
            if wide and self._register_one_of(ranked, wide=True):
                return True
            if not ranked or not self._ladder.relax():
                return self._reconsider(available)

    def _register_one_of(self, ranked: Sequence[tuple[int, int]], *, wide: bool) -> bool:
        """Register the first of some images that can be; each comes with a registered one."""
        for image, reference in ranked:
            references = self._references(image, reference, wide=wide)
            if self._known_to_fail(image, references):
                continue
            reason = self._try_image(image, references)
            if reason is None:
                self._ladder.reset()
                self._accept(image)
                return True
            self.journal.rejected(image, reason)
        return False

    def _reconsider(self, available: Bool) -> bool:
        """Register a contradicted image, if refining everything around it settles that.

        Where a loop closes, drift contradicts a right pose. False when none can be.
        """
        self._ladder.reset()
        scores = np.where(self.attempts.refuted, self._scores, 0)
        options = self._options.registration
        for image, reference in rank_next_images(self.scene, scores, available, options):
            self.attempts.refuted[image] = False
            references = self._references(image, reference)
            if self._try_image(image, references, everything=True) is None:
                self._accept(image)
                self.attempts.forget()
                return True
        return False

    def _displace(self) -> bool:
        """Take out the image that most newcomers contradicted, if several did; each image once."""
        culprit = self.attempts.take_culprit(self.scene.registered)
        if culprit is None or self.size <= 2:
            return False
        image, count = culprit
        self._drop([image], f"{count} other images contradict its depth")
        self.attempts.forget()
        return True

    def _references(self, image: int, reference: int, *, wide: bool = False) -> list[int]:
        """The registered images by whose points an image is posed.

        Those that share most points with the ``reference``; or, if ``wide``, match the image best.
        """
        scores, options = self._scores, self._options.registration
        if wide:
            matching = np.flatnonzero(self.scene.registered & (scores[image] > 0))
            order = np.argsort(-scores[image, matching], kind="stable")
            nearby = matching[order[:WIDE_REFERENCES]].tolist()
        else:
            nearby = local_bundle(self.scene, reference, options.num_neighbors, scores)
        return [other for other in nearby if not self.attempts.refuted[image, other]]

    def _known_to_fail(self, image: int, references: list[int]) -> bool:
        """Whether even the best pose of the same attempt before lacks support still."""
        if not self.attempts.exhausted(image, references):
            return False
        best = self.attempts.best_pose(image)
        return best is None or self._ladder.objection(best) is not None

    def _find_poses(
        self, image: int, references: list[int], found: Correspondences
    ) -> list[AbsolutePose]:
        """Possible poses of an image, best first, that of earlier attempts among them."""
        options, attempts = self._options.registration, self.attempts
        poses = []
        known = attempts.best_pose(image)
        if known:
            poses.append(rate_pose(self.scene, found, known.hypothesis, options))
        search = not attempts.exhausted(image, references)
        if search:
            poses += self._search.poses(image, found, attempt=attempts.searches(image))
        poses.sort(key=lambda pose: -pose.support)
        attempts.remember(image, references, poses[0] if poses else None, searched=search)
        return poses

    def _try_image(
        self, image: int, references: list[int], *, everything: bool = False
    ) -> str | None:
        """Register an image with the first of its possible poses that holds; None, or why not.

        ``everything``: refine all before the depth check, not just the image. Only a pose that
        nearly all matches support is worth that time.
        """
        scene = self.scene
        with self.journal.timed("registration"):
            found = correspondences(scene, image, references, self._options.registration)
            most = int(np.bincount(found.references, found.worth, minlength=1).max())
            if most < self._ladder.min_inliers:
                return f"{most} matches have a 3D point, {self._ladder.min_inliers} are needed"
            poses = self._find_poses(image, references, found)
        snapshot, noise = scene.snapshot(), self.refiner.noise
        reason: str | None = "neither PnP nor an essential matrix gives a pose"
        for pose in poses:
            reason = self._ladder.objection(pose, certain=everything)
            if not everything:
                reason = reason or self.attempts.refusal(image, pose)
            if reason is None:
                reason = self._try_pose(image, pose, found, everything=everything)
                if reason is None:
                    return None
                self.attempts.refuse(image, pose, reason)
                scene.restore(snapshot)
                self.refiner.noise = noise
                self.refiner.forget(image)
        return reason

    def _try_pose(
        self, image: int, pose: AbsolutePose, found: Correspondences, *, everything: bool
    ) -> str | None:
        """Grow and refine the scene around a new pose; None, or why it is rejected."""
        scene, options = self.scene, self._options
        with self.journal.timed("local refinement"):
            scene.register(image, pose.rotation, pose.translation)
            triangulate_image(scene, image, options.triangulation)
            bundle = local_bundle(scene, image, options.refinement.local_images - 1, self._scores)
            self.refiner.estimate_scale(image, bundle[1:])
            wide = options.refinement.first_reprojection_scale
            self.refiner.adjust([image], local=True, reprojection_scale=wide)
            filter_points(scene, options.triangulation, [image])
            if image in lost_images(scene):
                return "too few points are left after refinement"
            self.refiner.estimate_scale(image, bundle[1:])
            self.refiner.integrate([image])
        if everything:
            with self.journal.timed("global refinement"):
                self.refiner.refine_locally(image)
                self.refiner.refine_globally()
        reason = self._contradiction(image, self._options.consistency.max_violations)
        if reason:
            self._refute(image, pose, found)
            return reason
        with self.journal.timed("local refinement"):
            self.refiner.refine_locally(image)
        lost = lost_images(scene)
        if image in lost:
            return "too few points are left after refinement"
        self._drop(lost, "lost its points when another image was refined")
        return None

    def _refute(self, image: int, pose: AbsolutePose, found: Correspondences) -> None:
        """Try an image no more beside those whose matches led to a contradicted pose."""
        for other in map(int, np.unique(found.references)):
            alone = found.select(found.references == other)
            options = self._options.registration
            led = rate_pose(self.scene, alone, pose.hypothesis, options)
            self.attempts.refuted[image, other] |= led.inlier_share >= options.min_inlier_share

    def _contradiction(self, image: int, limit: float) -> str | None:
        """Why the depth of an image contradicts that of another view, if it does.

        ``limit``: share of pixels at the strict thresholds.
        """
        if not self._options.consistency.enabled:
            return None
        with self.journal.timed("depth check"):
            check = self._check.of_image(image, self.refiner.std_factor)
        if check.share <= self._ladder.max_violations(limit):
            return None
        self.attempts.blame(check.other, image)
        other = self._problem.images[check.other].name
        return f"{check.share:.0%} of the pixels contradict the depth of {other}"

    def _grown(self) -> bool:
        """Whether images or points grew so much that everything should be refined."""
        images, points = self.size, len(self.scene.tracks)
        growth = 1 + self._options.refinement.global_growth
        return images > growth * self._last_size[0] or points > growth * self._last_size[1]

    def _refine_globally(self, *, final: bool = False) -> None:
        before = self.scene.snapshot()
        with self.journal.timed("global refinement"):
            self.refiner.refine_globally(final=final)
            self.scene.tracks.compact()
        self._undo_jump(before)
        self.attempts.forget()
        self._last_size = self.size, len(self.scene.tracks)
        self._drop(lost_images(self.scene), "lost its points in global refinement")
        self.journal.scene_changed(self.scene)

    def _undo_jump(self, before: Snapshot) -> None:
        """Return to an earlier state if cameras jumped and their depth contradicts since then.

        A robust loss has many minima; where few matches hold images, the next one may be wrong.
        """
        images = self.scene.registered_images()
        turns = self.scene.rotations[images] @ before.rotations[images].transpose(0, 2, 1)
        if not len(images) or rotation_angle_deg(turns).max() < JUMP_DEG:
            return
        limit = self._options.consistency.max_violations
        after, worse = self.scene.snapshot(), len(self._conflicts(images, limit))
        self.scene.restore(before)
        if not worse > len(self._conflicts(images, limit)):
            self.scene.restore(after)

    def _conflicts(self, images: Int64, limit: float) -> list[tuple[int, float]]:
        """Views to leave out so that none contradicts one of the images, and how much each did."""
        if not self._options.consistency.enabled:
            return []
        with self.journal.timed("depth check"):
            return self._check.conflicting_images(images, limit, self.refiner.std_factor)

    def _check_all(self, limit: float, when: str) -> None:
        """Deregister images until no two views contradict each other.

        Those that held before are not compared with each other again.
        """
        images = self.scene.registered & ~self._checked
        self._checked |= images
        conflicting = self._conflicts(np.flatnonzero(images), limit)
        for image, share in conflicting:
            self._drop([image], f"{when} {share:.0%} of the pixels contradict another view's")
        if conflicting:
            apart = disconnected_images(self.scene)
            self._drop(apart, f"held to the rest only by an image that was dropped {when}")

    def _accept(self, image: int) -> None:
        self.attempts.scene_changed()
        self.journal.registered(image, self.size)
        self.journal.scene_changed(self.scene)

    def _drop(self, images: list[int], reason: str) -> None:
        """Take images out that were registered before; the run goes on."""
        for image in images:
            if self.refiner.fixed[image]:
                continue
            self._checked[image] = False
            self.scene.deregister(image)
            self.refiner.forget(image)
            self.attempts.scene_changed()
            self.journal.rejected(image, reason)
