"""Localization of images in a model whose poses do not change.

Usage::

    model = triangulate_model(problem, options)            # points and depth for the known poses
    localizer = Localizer(extended_problem, model, options)
    outcome = localizer.localize(image)                    # pose, or the reason without a pose

An image is registered by :mod:`mpsfm_core.mapping.incremental_registration`, with points of the
model that are triangulated or lifted from the depth of a single image of the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, PinholeCamera, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.event_log import EventLog
from mpsfm_core.mapping.events import MappingEvents, NullMappingEvents
from mpsfm_core.mapping.initialization.initial_pair import InitialPairSelector
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.filtering import filter_points, find_lost_images
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks


@dataclass(frozen=True, eq=False)
class FixedModel:
    """Model with fixed poses, in which images are localized."""

    problem: MappingProblem
    """Images of the model with known poses, keypoints and priors, and their verified pairs."""
    state: StateDict
    """State of :class:`~mpsfm_core.mapping.scene.scene.Scene` with points and refined depth."""
    wrong_depth: tuple[int, ...] = ()
    """Images whose depth contradicts other images of the model, so that no new image is rejected
    because of their depth."""

    @property
    def num_points(self) -> int:
        """Number of 3D points of the model."""
        return len(self.state["xyz"])


@dataclass(frozen=True, eq=False)
class LocalizedImage:
    """Pose of an image in a fixed model."""

    name: str
    camera: PinholeCamera
    """Intrinsics of the undistorted view, with the estimated focal length."""
    rotation: Float64
    """(3, 3) float64 rotation of ``cam_from_world``."""
    translation: Float64
    """(3,) float64 translation of ``cam_from_world``, in units of the model."""
    covariance: Float64
    """(6, 6) covariance of ``w`` and ``dt`` in ``R <- exp(w) R, t <- t + dt``, in radians and units
    of the model."""
    num_matches: int
    """Number of keypoints that match an image of the model."""
    keypoints: Float64
    """(n, 2) keypoints that observe a 3D point (inliers), in pixels of the undistorted view."""
    matches: Mapping[str, tuple[Float64, Float64]]
    """Keypoints of the image and of an image of the model, each (m, 2) in pixels of the undistorted
    views, that observe the same 3D point, by name of the image of the model."""

    contradiction: Reason | None = None
    """``ImageReason.CONTRADICTS_IMAGE`` if the depth of the image contradicts the model."""

    @property
    def num_inliers(self) -> int:
        """Number of keypoints that observe a 3D point of the model."""
        return len(self.keypoints)


def triangulate_model(
    problem: MappingProblem, options: MapperOptions, events: MappingEvents | None = None
) -> FixedModel:
    """Triangulate points and refine depth maps of images with known poses.

    Args:
        problem: Images that all have a known pose, at least two, and their verified pairs.
        options: Options of the mapper.
        events: Receiver of progress events.
    """
    component = _create_component(
        problem, options, EventLog(problem, events or NullMappingEvents())
    )
    component.initialize_from_known_poses(np.ones(len(problem.images), dtype=np.bool_))
    wrong_depth = component.maintenance.find_wrong_depth()
    return FixedModel(problem, component.scene.state_dict(), tuple(wrong_depth))


def snap_to_observations(
    problem: MappingProblem, model: FixedModel, max_distance_px: float
) -> MappingProblem:
    """Replace matched keypoints in images of the model by near keypoints that observe a point.

    Matches of new images have new keypoints in the images of the model, which observe no 3D point.

    Args:
        problem: Mapping problem that starts with the images and keypoints of the model.
        model: The model.
        max_distance_px: Largest distance between both keypoints, in pixels.
    """
    rows_of: dict[int, Int64] = {}
    offset = 0
    for index, image in enumerate(model.problem.images):
        count = len(image.keypoints)
        observed = np.flatnonzero(model.state["point_of"][offset : offset + count] >= 0)
        offset += count
        xy = problem.images[index].keypoints
        rows = np.arange(len(xy))
        if len(observed):
            distance, nearest = cKDTree(xy[observed]).query(xy[count:])
            near = distance <= max_distance_px
            rows[count:][near] = observed[nearest[near]]
        rows_of[index] = rows

    def snap(pair: VerifiedPair) -> VerifiedPair:
        if pair.image_a not in rows_of or pair.image_b in rows_of:
            return pair
        rows = rows_of[pair.image_a][pair.matches[:, 0]]
        return replace(pair, matches=np.column_stack([rows, pair.matches[:, 1]]))

    return replace(problem, pairs=tuple(map(snap, problem.pairs)))


class Localizer:
    """Localization of images in a fixed model, which leaves the model unchanged.

    Args:
        problem: Mapping problem that starts with the images of the model, followed by the images to
            localize.
        model: The model.
        options: Options of the mapper.
        events: Receiver of progress events.
    """

    def __init__(
        self,
        problem: MappingProblem,
        model: FixedModel,
        options: MapperOptions,
        events: MappingEvents | None = None,
    ) -> None:
        self._log = EventLog(problem, events or NullMappingEvents())
        self._component = _create_component(problem, options, self._log)
        self._options = options
        self._load(model)

    def localize(self, image: int) -> LocalizedImage | Reason:
        """Estimate the pose of one image, independently of other images to localize.

        Args:
            image: Index of the image in the mapping problem.

        Returns:
            The localized image, or the reason why the image has no pose.
        """
        return self.localize_together([image])[0]

    def localize_together(self, images: Sequence[int]) -> list[LocalizedImage | Reason]:
        """Estimate the poses of images that share a guessed camera or a rig, or match each other.

        Images that share a guessed camera get one refined focal length. The images of a frame of a
        rig get one pose from the matches of all of them, and the scale of the rigs is refined. An
        image that matches no image of the model can be registered by its matches with other images.
        Poses that agree with the depth of the model come first; images without such a pose are
        registered without the depth check, and :attr:`LocalizedImage.contradiction` tells what the
        check found.

        Args:
            images: Indices of the images in the mapping problem.

        Returns:
            The localized image or the reason why it has no pose, for each of the images.
        """
        with self._placed(images) as outcomes:
            return outcomes

    def localize_sequence(
        self, images: Sequence[int]
    ) -> tuple[list[LocalizedImage | Reason], Reconstruction]:
        """Localize images as :meth:`localize_together`, and copy their points and depth.

        Args:
            images: Indices of the images in the mapping problem.

        Returns:
            The outcome for each image, and the reconstruction of the localized images in the world
            of the model.
        """
        with self._placed(images) as outcomes:
            part = convert_scene(self._component.scene, keep_units=True)
        localized = tuple(image for image in part.images if image.index in images)
        return outcomes, replace(part, images=localized)

    @contextmanager
    def _placed(self, images: Sequence[int]) -> Iterator[list[LocalizedImage | Reason]]:
        """Register images, yield the outcome for each of them, and restore the model."""
        maintenance, scene = self._component.maintenance, self._component.scene
        before = maintenance.state()
        candidates = scene.mask(list(images))
        self._register(candidates)
        checked = scene.registered.copy()
        with maintenance.depth_check_disabled():
            self._register(candidates)
        placed = [int(image) for image in np.flatnonzero(candidates & scene.registered)]
        self._refine(placed)
        limit = self._options.consistency.max_violations
        outcomes = [
            self._describe(image, None if checked[image] else maintenance.check_depth(image, limit))
            if scene.registered[image]
            else self._log.image_reasons[scene.problem.images[image].name]
            for image in images
        ]
        yield outcomes
        maintenance.restore(before)

    def _register(self, candidates: Bool) -> None:
        """Register as many of the candidates as possible."""
        while self._component.registration.register_next_image(candidates, wide=True):
            pass
        self._component.maintenance.thresholds.reset()
        self._component.maintenance.history.clear()

    def _load(self, model: FixedModel) -> None:
        """Load poses, points and depth maps of the model into the scene."""
        scene, num_images = self._component.scene, len(model.problem.images)
        state = scene.state_dict()
        for name in ("rotations", "translations", "registered"):
            state[name][:num_images] = model.state[name]
        state["maps"][:num_images] = model.state["maps"]
        state["xyz"] = model.state["xyz"]
        offset = 0
        for index, image in enumerate(model.problem.images):
            start, count = scene.graph.keypoints_of(index).start, len(image.keypoints)
            state["point_of"][start : start + count] = model.state["point_of"][
                offset : offset + count
            ]
            offset += count
        scene.load_state_dict(state)
        refiner = self._component.refiner
        refiner.fixed[:num_images] = True
        refiner.refine_depth([])
        self._component.maintenance.exclude_depth(model.wrong_depth)

    def _refine(self, images: list[int]) -> None:
        """Refine poses, guessed focal lengths and depth scales of newly registered images."""
        if not images:
            return
        component, scene = self._component, self._component.scene
        refiner, triangulation = component.refiner, self._options.triangulation
        is_guessed = any(not scene.problem.images[image].focal_known for image in images)
        if is_guessed and self._options.refinement.refine_focal:
            refiner.adjust(images, focal=True)
        complete_and_merge_tracks(scene, triangulation, images=images)
        refiner.adjust(images)
        filter_points(scene, triangulation, images)
        refiner.adjust(images)
        lost = [image for image in find_lost_images(scene) if image in images]
        reason = ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT.because()
        component.maintenance.deregister(lost, reason)

    def _describe(self, image: int, contradiction: Reason | None) -> LocalizedImage:
        """Copy pose, camera, covariance and inliers of a registered image."""
        scene, graph = self._component.scene, self._component.scene.graph
        edges = graph.edges_of(image)
        source, target = graph.source[edges], graph.target[edges]
        known = scene.registered[graph.image_of[target]]
        point = scene.tracks.point_of
        explained = (point[source] >= 0) & (point[source] == point[target]) & known
        inliers = np.unique(source[explained])
        matches = {}
        for other in map(int, np.unique(graph.image_of[target[explained]])):
            rows = explained & (graph.image_of[target] == other)
            name = scene.problem.images[other].name
            matches[name] = scene.keypoints[source[rows]], scene.keypoints[target[rows]]
        return LocalizedImage(
            scene.problem.images[image].name,
            scene.camera(image),
            scene.rotations[image].copy(),
            scene.translations[image].copy(),
            self._component.refiner.compute_pose_covariance(image),
            len(np.unique(source[known])),
            scene.keypoints[inliers].copy(),
            matches,
            contradiction,
        )


def _create_component(problem: MappingProblem, options: MapperOptions, log: EventLog) -> Component:
    """Create an empty component, in which known poses stay fixed."""
    options = options.model_copy(update={"known_poses": "fixed"})
    return Component(problem, options, InitialPairSelector(options), log)
