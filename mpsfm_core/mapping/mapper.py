"""Incremental mapper with depth and normal priors.

Usage::

    result = reconstruct(problem, MapperOptions())
    for model in result.reconstructions:  # components, the largest first
        print(len(model.images), len(model.points))

The steps of :func:`reconstruct`, compared with COLMAP's ``IncrementalMapper``::

    for each seed:
        while images are unregistered:
            component = new component
            component.initialize_from_model()           # joined reconstructions of parts, or
            component.initialize_from_known_poses()     # poses that came with the images, or
            component.initialize_globally()             # all well connected images, or
            component.initialize_from_pair()            # one pair, best first
            while an image registers:                   # component.register_images()
                select the next image, estimate its pose, verify it by depth, triangulate
                refine locally; refine globally if the model has grown
            component.reregister_images()               # misregistered images in other poses
            component.finalize()                        # last refinement, depth check of all
        stop if enough matches are explained, no guessed focal length was far off, no image
            deviates from the focal length of its shared camera, and no rig got calibrated
    select the run with the highest score               # likelihood of matches and depth
    register duplicates in the poses of their originals
    register the remaining images tentatively           # if this option is set
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.checkpoints import Checkpointer, CheckpointStore
from mpsfm_core.mapping.component import Component, do_nothing
from mpsfm_core.mapping.consistency.pair_consistency import reweight_pairs
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.events import MappingEvents, NullMappingEvents
from mpsfm_core.mapping.initialization.initial_pair import InitialPairSelector
from mpsfm_core.mapping.initialization.refined_focal_lengths import apply_refined_focal_lengths
from mpsfm_core.mapping.initialization.rig_calibration import calibrate_rigs
from mpsfm_core.mapping.initialization.view_graph_calibration import calibrate_view_graph
from mpsfm_core.mapping.model_selection import (
    MapperRun,
    compute_explained_ratios,
    has_refuted_rigs,
    is_settled,
    select_run,
    sum_step_times,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.duplicate_registration import (
    register_duplicates,
    remove_duplicates,
    report_duplicates,
)
from mpsfm_core.mapping.registration.tentative_registration import register_tentatively
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.support.memory import release_free_memory

MIN_ABSORBING_RATIO = 0.25
"""Minimum size of a component, relative to the largest component, to absorb images of completed
components. [ours]"""


class JoinedParts(NamedTuple):
    """Joined reconstructions of overlapping parts, with which the mapper continues."""

    models: Sequence[Reconstruction] = ()
    """Joined reconstructions, the largest first."""
    compared: Sequence[Int64] = ()
    """Indices of the images of each part, whose depth was compared with each other."""


NO_PARTS = JoinedParts()


def reconstruct(
    problem: MappingProblem,
    options: MapperOptions | None = None,
    events: MappingEvents | None = None,
    checkpoints: CheckpointStore | None = None,
    parts: JoinedParts = NO_PARTS,
) -> MappingResult:
    """Reconstruct poses, points and refined depth of all images that can be verified.

    Guessed focal lengths and distortion that image pairs contradict are replaced first. If
    many matches observe no common 3D point, the mapper runs again with other random seeds. If
    guessed focal lengths were far off, the mapper runs again with the refined focal lengths. If a
    rig has an unknown relative pose, the mapper runs again with the rig that the first run
    calibrates, and drops the rig if the rig explains fewer matches. The run with the highest
    score (likelihood of matches and depth) is kept. The same problem, options and machine give
    bit-identical results, also if an interrupted run continues from a checkpoint.

    Args:
        problem: Images with depth and normal priors, and geometrically verified matches.
        options: Options of the mapper.
        events: Receiver of progress events.
        checkpoints: Storage of checkpoints.
        parts: Joined reconstructions of parts, from which the first components of one run start.

    Returns:
        Connected components, sorted by decreasing number of images, and the report.
    """
    options, events = options or MapperOptions(), events or NullMappingEvents()
    if options.known_poses == "fixed" and any(i.known_pose is not None for i in problem.images):
        problem = replace(problem, rigs=())  # fixed poses are not estimated, so rigs are not needed
    checkpointer = Checkpointer(checkpoints)
    runs, interrupted = checkpointer.load()
    is_complete = bool(runs) and interrupted is None
    pair_weights = None
    distinct = remove_duplicates(problem, options)
    initial_problem = _calibrate(distinct, runs, options, parts)
    for number in range(len(runs), 0 if is_complete else options.max_runs):
        run_options = options.model_copy(update={"seed": options.seed + number})
        mapper = Mapper(initial_problem, run_options, events, pair_weights, parts)
        if interrupted is not None:
            mapper.load_state_dict(interrupted)
            interrupted = None

        def save_checkpoint(mapper: Mapper = mapper) -> None:
            checkpointer.save_if_due(runs, mapper, mapper.component.size)

        runs.append(mapper.run(save_checkpoint))
        pair_weights = mapper.pair_weights
        if mapper.is_deterministic or parts.models:
            break
        next_problem = _improve_problem(initial_problem, runs, options)
        is_refuted = has_refuted_rigs(initial_problem, runs)
        if next_problem is not None:
            initial_problem, pair_weights = next_problem, None
        is_last = is_refuted or next_problem is None
        if is_last and is_settled(runs[:-1] if is_refuted else runs, options.enough_explained):
            break
    if not is_complete:
        checkpointer.save_completed(runs)
    return _complete_result(select_run(runs, distinct), runs, problem, distinct, options)


def _calibrate(
    problem: MappingProblem, runs: Sequence[MapperRun], options: MapperOptions, parts: JoinedParts
) -> MappingProblem:
    """Return the problem with cameras and rigs from image pairs, parts and completed runs."""
    refinement, calibrated = options.refinement, problem
    if parts.models:
        calibrated = calibrate_rigs(problem, parts.models) or problem
    elif refinement.refine_focal:
        calibrated = calibrate_view_graph(
            problem, options.seed, refine_distortion=refinement.refine_distortion
        )
    for count in range(1, len(runs) + 1):  # completed mapper runs, oldest first
        calibrated = _improve_problem(calibrated, runs[:count], options) or calibrated
    return calibrated


def _complete_result(
    selected: MapperRun,
    runs: Sequence[MapperRun],
    problem: MappingProblem,
    distinct: MappingProblem,
    options: MapperOptions,
) -> MappingResult:
    """Register duplicates and unverified images in the models of the selected run.

    Args:
        selected: The selected mapper run.
        runs: All mapper runs.
        problem: The mapping problem.
        distinct: The mapping problem without duplicates.
        options: Options of the mapper.
    """
    models = list(selected.models)
    distinct = calibrate_rigs(distinct, models) or distinct
    if models and options.register_tentatively:
        models[0] = register_tentatively(models[0], models[1:], distinct, options)
    report = sum_step_times(selected.report, [run.report for run in runs])
    if distinct is not problem:
        models = [register_duplicates(model, problem) for model in models]
        report = replace(report, image_reasons=report_duplicates(report, models, problem))
    return MappingResult(tuple(models), report)


def _improve_problem(
    problem: MappingProblem, runs: Sequence[MapperRun], options: MapperOptions
) -> MappingProblem | None:
    """Return the problem with focal lengths and rigs of the last run, None if unchanged.

    Estimated rigs with which the last run explains fewer matches than an earlier run are dropped.
    """
    if has_refuted_rigs(problem, runs):
        return replace(problem, rigs=tuple(rig for rig in problem.rigs if not rig.is_estimated))
    run, improved = runs[-1], None
    if run.models and options.refinement.refine_focal:
        improved = apply_refined_focal_lengths(problem, run.models[0], options)
    return calibrate_rigs(improved or problem, run.models) or improved


class Mapper:
    """One run of the mapper with one seed.

    From a checkpoint of the attributes between two image registrations, a mapper run continues with
    identical results.

    Attributes:
        component: The current component.
        models: The completed components.
        unregistered: (n,) bool mask of the images that are in no completed component.
        pair_weights: (p,) float64 weights of the match scores of each image pair from depth
            checks, or None before such checks.
    """

    component: Component

    def __init__(
        self,
        problem: MappingProblem,
        options: MapperOptions,
        events: MappingEvents,
        pair_weights: Float64 | None = None,
        parts: JoinedParts = NO_PARTS,
    ) -> None:
        self.problem = problem
        self.options = options
        self.event_log = EventLog(problem, events)
        self.models: list[Reconstruction] = []
        self.unregistered: Bool = np.ones(len(problem.images), dtype=np.bool_)
        self._pair_selector = InitialPairSelector(options)
        self._parts = parts
        self._num_components = 0
        self._is_growing = False
        self._uses_known_poses = sum(image.known_pose is not None for image in problem.images) >= 2

        self._set_pair_weights(pair_weights)

    def state_dict(self) -> StateDict:
        """Return the state of the mapper run between two image registrations, for a checkpoint."""
        return {
            "component": self.component.maintenance.state_dict(),
            "event_log": self.event_log.state_dict(),
            "models": [model.state_dict() for model in self.models],
            "num_components": self._num_components,
            "pair_selector": self._pair_selector.state_dict(self._weighted_problem.pairs),
            "pair_weights": self.pair_weights,
            "unregistered": self.unregistered,
            "uses_known_poses": self._uses_known_poses,
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the state of a mapper run from a checkpoint of the same problem and options."""
        self._set_pair_weights(state["pair_weights"])
        self._pair_selector.load_state_dict(state["pair_selector"], self._weighted_problem.pairs)
        self.event_log.load_state_dict(state["event_log"])
        self.models = [Reconstruction.from_state_dict(model) for model in state["models"]]
        self.unregistered = state["unregistered"]
        self._num_components = state["num_components"]
        self._uses_known_poses = state["uses_known_poses"]
        self.component = self._create_component()
        self.component.maintenance.load_state_dict(state["component"])
        self._is_growing = True

    def _set_pair_weights(self, weights: Float64 | None) -> None:
        self.pair_weights = weights
        self._weighted_problem = (
            self.problem if weights is None else reweight_pairs(self.problem, weights)
        )

    @property
    def is_deterministic(self) -> bool:
        """True if known poses stay fixed, so that another random seed gives the same result."""
        return self._uses_known_poses and self.options.known_poses == "fixed"

    def run(self, save_checkpoint: Callable[[], None] = do_nothing) -> MapperRun:
        """Reconstruct all components.

        Args:
            save_checkpoint: Function that is called whenever the mapper state can be saved.
        """
        components = self.reconstruct_components(save_checkpoint)
        models = sorted(components, key=lambda model: -len(model.images))
        explained_ratios = compute_explained_ratios(models, self.problem)
        return MapperRun(models, explained_ratios, self.event_log.report(models))

    def reconstruct_components(
        self, save_checkpoint: Callable[[], None] = do_nothing
    ) -> list[Reconstruction]:
        """Reconstruct components until no image remains or no component can be initialized."""
        max_components = self.options.max_components
        while self._num_components < max_components:
            if not self.reconstruct_component(save_checkpoint):
                return self.models
            del self.component  # the next component and the final steps need its memory
            release_free_memory()
            self._num_components += 1
        reason = ImageReason.COMPONENT_LIMIT.because(max_components=max_components)
        self._reject(self.unregistered, reason)
        return self.models

    def reconstruct_component(self, save_checkpoint: Callable[[], None] = do_nothing) -> bool:
        """Reconstruct the next component, or continue an interrupted component.

        Returns:
            False if no further component can be reconstructed.
        """
        if not self._is_growing:
            if np.count_nonzero(self.unregistered) < 2:
                return False
            self.component = self._create_component()
            if not (
                self._initialize_from_model()
                or self._initialize_from_known_poses()
                or self._initialize()
            ):
                return False
            self._is_growing = True
        save_checkpoint()
        if not self.is_deterministic:
            candidates = self._select_candidates()
            self.component.register_images(candidates, save_checkpoint)
            self.component.reregister_images(candidates)
        self._is_growing = False
        if self._uses_known_poses or self._parts.models or not self._absorb_components():
            self.component.finalize()
        self._store_component()
        if self.is_deterministic:
            self._reject(self.unregistered, ImageReason.NO_KNOWN_POSE.because())
        return not self.is_deterministic

    def _create_component(self) -> Component:
        return Component(self._weighted_problem, self.options, self._pair_selector, self.event_log)

    def _initialize(self) -> bool:
        """Initialize the component from globally averaged poses, or else from an image pair.

        If the first global initialization fails, depth checks of image pairs reweight the match
        scores. A second global initialization follows if the scores of a pair changed.
        """
        if self._initialize_globally():
            return True
        if self.pair_weights is None and self.options.checks_pairs:
            with self.event_log.timed("pair consistency check"):
                weights = self.component.compute_pair_weights(self.unregistered)
            self._set_pair_weights(weights)
            self.component = self._create_component()
            if (weights != 1.0).any() and self._initialize_globally():
                return True
        return self.component.initialize_from_pair(self.unregistered)

    def _initialize_from_model(self) -> bool:
        """Start the component from the next joined reconstruction of parts, if one remains."""
        models, compared = self._parts
        if self._num_components >= len(models):
            return False
        if self.component.initialize_from_model(models[self._num_components], compared):
            return True
        self.component = self._create_component()
        return False

    def _select_candidates(self) -> Bool:
        """Return the unregistered images (n,), without those of the remaining initial models."""
        candidates: Bool = self.unregistered.copy()
        for model in self._parts.models[self._num_components + 1 :]:
            candidates[[image.index for image in model.images]] = False
        return candidates

    def _initialize_globally(self) -> bool:
        return self.options.global_initialization and self.component.initialize_globally(
            self.unregistered
        )

    def _initialize_from_known_poses(self) -> bool:
        if self._uses_known_poses and not self.component.initialize_from_known_poses(
            self.unregistered
        ):
            self._uses_known_poses = False
            self.component = self._create_component()
        return self._uses_known_poses

    def _absorb_components(self) -> bool:
        """Absorb images of completed components if the current component becomes the largest.

        A bad initialization leads to a small component, whose images fit a later component better.
        Completed components that lose an image are dissolved, and their images become unregistered.
        Images with a known pose are not absorbed.

        Returns:
            True if the current component took images of completed components and was finalized.
        """
        component = self.component
        max_size = max((len(model.images) for model in self.models), default=0)
        if not max_size or component.size < MIN_ABSORBING_RATIO * max_size:
            return False
        before = component.maintenance.state()
        component.maintenance.history.clear()
        component.register_images(
            np.array([image.known_pose is None for image in self.problem.images])
        )
        if component.size > max_size:
            component.finalize()
        if component.size <= max_size:
            component.maintenance.restore(before)
            return False
        for model in list(self.models):
            images = [image.index for image in model.images]
            if component.scene.registered[images].any():
                self.models.remove(model)
                self.unregistered[images] = True
        return True

    def _store_component(self) -> None:
        """Convert the component to a reconstruction, or reject its images if it is too small."""
        scene, size, min_size = (
            self.component.scene,
            self.component.size,
            self.options.min_model_size,
        )
        self.unregistered &= ~scene.registered
        if size >= min_size:
            # known poses define the world and its unit, unless they are only an initial guess
            keep_units = self._uses_known_poses and self.options.known_poses != "guess"
            refiner = self.component.refiner
            predicts = self.options.predict_errors
            errors = refiner.predict_calibration_errors() if predicts else None
            self.models.append(convert_scene(scene, errors, keep_units=keep_units))
        else:
            reason = ImageReason.COMPONENT_TOO_SMALL.because(num_images=size, min_images=min_size)
            self._reject(scene.registered, reason)

    def _reject(self, images: Bool, reason: Reason) -> None:
        for image in np.flatnonzero(images):
            self.event_log.rejected(int(image), reason)
