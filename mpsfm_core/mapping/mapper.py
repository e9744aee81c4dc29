"""A reconstruction of all images: group after group, each from its own start; in several runs where
random choices decide."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from mpsfm_core.data import Bool, MappingProblem
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.checkpoints import Checkpoints, Keeper
from mpsfm_core.mapping.component import Group, nothing
from mpsfm_core.mapping.event_log import Journal
from mpsfm_core.mapping.events import MappingEvents, NullMappingEvents
from mpsfm_core.mapping.initialization.initial_pair import InitialPairSelector
from mpsfm_core.mapping.model_selection import Run, best, explained_shares, settled, with_all_times
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.tentative_registration import register_tentatively
from mpsfm_core.mapping.scene.conversion import finished
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction
from mpsfm_core.mapping.state import canonical

CONTENDER_SHARE = 0.25
"""Of the number of images of the largest group, with which another contends for them (ours)."""


def reconstruct(
    problem: MappingProblem,
    options: MapperOptions | None = None,
    events: MappingEvents | None = None,
    checkpoints: Checkpoints | None = None,
) -> MappingResult:
    """Pose as many images as can be posed confidently, with points and refined depth.

    Disconnected groups of images become reconstructions of their own, the largest first. Where
    much of the matches stays unexplained, other random choices may come to more: then there are
    several runs, and that counts which explains most, or one that came out twice if it explains as
    much. The result is the same bit for bit for the same problem, options and machine, also where a
    run that ended early goes on from one of its ``checkpoints``.
    """
    options, events = options or MapperOptions(), events or NullMappingEvents()
    problem = canonical(problem)
    keeper = Keeper(checkpoints, problem, events)
    runs, unfinished = keeper.load()
    finished_before = bool(runs) and unfinished is None
    weighed = None
    for number in range(len(runs), 0 if finished_before else options.max_runs):
        own = options.model_copy(update={"seed": options.seed + number})
        mapper = unfinished or Mapper(problem, own, events, weighed)
        runs.append(mapper.run(partial(keeper.save, runs, mapper)))
        weighed = mapper.weighed
        unfinished = None
        if mapper.keeps_poses or settled(runs, options.enough_explained):
            break
    keeper.finish(runs)
    chosen = best(runs, options.consistency)
    models = list(chosen.models)
    if models and options.register_tentatively:
        models[0] = register_tentatively(models[0], models[1:], problem, options)
    return MappingResult(tuple(models), with_all_times(chosen.report, runs))


class Mapper:
    """One run. ``models`` are the groups, ``left`` the images in none, ``group`` the last one.
    ``weighed``: the problem with its pairs as far as depth allows them, once that was asked.

    All that decides how a run goes on is in its attributes: between two images it can be kept and
    taken up again.
    """

    group: Group
    group_type: type[Group] = Group

    def __init__(
        self,
        problem: MappingProblem,
        options: MapperOptions,
        events: MappingEvents,
        weighed: MappingProblem | None = None,
    ) -> None:
        self.problem = problem
        self.weighed = weighed
        self.options = options
        self.journal = Journal(problem, events)
        self.models: list[Reconstruction] = []
        self.left: Bool = np.ones(len(problem.images), dtype=np.bool_)
        self._starts = InitialPairSelector(options)
        self._tried = 0
        self._growing = False
        self._poses_hold = sum(image.known_pose is not None for image in problem.images) >= 2

    @property
    def keeps_poses(self) -> bool:
        """Whether known poses stay as they are, so that nothing is left to chance."""
        return self._poses_hold and self.options.known_poses == "fixed"

    def run(self, paused: Callable[[], None] = nothing) -> Run:
        """Reconstruct all groups; ``paused`` is called where the run could be taken up again."""
        models = sorted(self.components(paused), key=lambda model: -len(model.images))
        return Run(models, explained_shares(models, self.problem), self.journal.report(models))

    def components(self, paused: Callable[[], None] = nothing) -> list[Reconstruction]:
        """Reconstruct one group of images after the other."""
        most = self.options.max_components
        while self._tried < most:
            if not self.reconstruct_next(paused):
                return self.models
            self._tried += 1
        self._reject(self.left, ImageReason.COMPONENT_LIMIT.because(max_components=most))
        return self.models

    def reconstruct_next(self, paused: Callable[[], None] = nothing) -> bool:
        """Reconstruct a group among the images that are left, or go on with the one that grows;
        False when there is none."""
        if not self._growing:
            if np.count_nonzero(self.left) < 2:
                return False
            self.group = self._new_group()
            if not self._start_from_known_poses() and not self._start():
                return False
            self._growing = True
        paused()
        known = self._poses_hold
        fixed = known and self.options.known_poses == "fixed"
        if not fixed:
            self.group.grow(self.left, paused)
            self.group.reseat(self.left)
        self._growing = False
        if known or not self._outgrow():
            self.group.finish()
        self._keep(in_users_world=known and self.options.known_poses != "guess")
        if fixed:
            self._reject(self.left, ImageReason.NO_KNOWN_POSE.because())
        return not fixed

    def _new_group(self) -> Group:
        problem = self.weighed or self.problem
        return self.group_type(problem, self.options, self._starts, self.journal)

    def _start(self) -> bool:
        """Start from all images at once, or else from a pair; if not all pairs go together, with
        those alone that depth allows."""
        if self._start_from_all():
            return True
        if self.weighed is None and self.options.checks_pairs:
            with self.journal.timed("pair check"):
                self.weighed = self.group.weighed_problem(self.left)
            self.group = self._new_group()
            if self._start_from_all():
                return True
        return self.group.start_from_pair(self.left)

    def _start_from_all(self) -> bool:
        at_once = self.options.initialization.global_initialization
        return at_once and self.group.start_from_all(self.left)

    def _start_from_known_poses(self) -> bool:
        if self._poses_hold and not self.group.start_from_known_poses(self.left):
            self._poses_hold = False
            self.group = self._new_group()
        return self._poses_hold

    def _outgrow(self) -> bool:
        """Take images of earlier groups, if this ends as the largest; those are dissolved then.

        A bad start holds few images, and would keep them from a good one that comes after it.
        Images that came with a pose stay where they are. Whether it came so; it is finished then.
        """
        group = self.group
        largest = max((len(model.images) for model in self.models), default=0)
        if not largest or group.size < CONTENDER_SHARE * largest:
            return False
        before = group.upkeep.state()
        group.upkeep.history.clear()
        group.grow(np.array([image.known_pose is None for image in self.problem.images]))
        if group.size > largest:
            group.finish()
        if group.size <= largest:
            group.upkeep.restore(before)
            return False
        for model in list(self.models):
            images = [image.index for image in model.images]
            if group.scene.registered[images].any():
                self.models.remove(model)
                self.left[images] = True
        return True

    def _keep(self, *, in_users_world: bool) -> None:
        """Keep the group if it is large enough; its images are no longer left."""
        scene, size, least = self.group.scene, self.group.size, self.options.min_model_size
        self.left &= ~scene.registered
        if size >= least:
            self.models.append(finished(scene, keep_units=in_users_world))
        else:
            reason = ImageReason.COMPONENT_TOO_SMALL.because(num_images=size, min_images=least)
            self._reject(scene.registered, reason)

    def _reject(self, images: Bool, reason: Reason) -> None:
        for image in np.flatnonzero(images):
            self.journal.rejected(int(image), reason)
