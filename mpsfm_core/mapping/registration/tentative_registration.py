"""Tentative registration of images whose poses cannot be verified.

Images outside the largest component are registered in the best supported poses. Tentatively
registered images observe no points and change neither points nor other poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import MappingProblem
from mpsfm_core.geometry import compose, invert
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.image_selection import (
    compute_pair_scores,
    rank_next_images,
)
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.scene.conversion import convert_image
from mpsfm_core.mapping.scene.local_bundle import find_local_bundle
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_image


def register_tentatively(
    reconstruction: Reconstruction,
    components: Sequence[Reconstruction],
    problem: MappingProblem,
    options: MapperOptions,
) -> Reconstruction:
    """Register all remaining images that have matches with the reconstruction.

    The image with the best supported pose is registered next, until no remaining image has matches.
    Tentatively registered images serve as reference images of later images.

    Args:
        reconstruction: The largest component.
        components: The other components. If one image of another component is registered, the whole
            component is registered with the same transformation.
        problem: The mapping problem that was reconstructed.
        options: Options of the mapper.

    Returns:
        The reconstruction with the tentatively registered images, whose ``confirmed`` is False.
    """
    registration = _TentativeRegistration(reconstruction, components, problem, options)
    registered = registration.register_all()
    if not registered:
        return reconstruction
    is_metric = reconstruction.metric is not None and reconstruction.metric.trusted
    tentative = [
        replace(convert_image(registration.scene, image, 1.0, is_metric), confirmed=False)
        for image in registered
    ]
    images = sorted([*reconstruction.images, *tentative], key=lambda image: image.index)
    return replace(reconstruction, images=tuple(images))


class _TentativeRegistration:
    """Registration of images without verification into a copy of the reconstructed scene."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        components: Sequence[Reconstruction],
        problem: MappingProblem,
        options: MapperOptions,
    ) -> None:
        self.scene = Scene(problem, weigh_by_score=options.weigh_by_score)
        self._options = options.registration
        self._scores = compute_pair_scores(self.scene)
        self._triangulation = options.triangulation
        self._refiner = Refiner(self.scene, options, self._scores)
        self._pose_estimator = AbsolutePoseEstimator(self.scene, self._refiner, options)
        self._poses: dict[int, tuple[list[int], ScoredPose | None]] = {}
        self._component_of = {
            image.index: component for component in components for image in component.images
        }
        self._median_scale = float(np.median([image.scale for image in reconstruction.images]))
        self.scene.resume(reconstruction)

    def register_all(self) -> list[int]:
        """Register one image or component after another, and return the registered images."""
        before = self.scene.registered.copy()
        while best := self._find_next_image():
            image, pose = best
            self._register_image(image, pose)
            if image in self._component_of:
                self._register_component(image, self._component_of[image])
        return [int(image) for image in np.flatnonzero(self.scene.registered & ~before)]

    def _register_image(self, image: int, pose: ScoredPose) -> None:
        """Register a frame, and scale the depth priors of its images by temporary points."""
        scene = self.scene
        before = scene.snapshot()
        scene.register(image, pose.rotation, pose.translation, pose.focal_px)
        members = scene.rigs.images_of(image)
        for member in members:
            triangulate_image(scene, member, self._triangulation)
        for member in members:
            self._refiner.estimate_scale(member, self._poses[image][0])
        maps = [scene.maps[member] for member in members]
        scales = [m.scale if m.active else self._median_scale for m in maps]
        scene.restore(before)
        scene.register(image, pose.rotation, pose.translation, pose.focal_px)
        for depth_map, scale in zip(maps, scales, strict=True):
            depth_map.set_scale(scale)

    def _register_component(self, image: int, component: Reconstruction) -> None:
        """Register the other images of a component by their poses relative to one of its images."""
        scene = self.scene
        (anchor,) = (member for member in component.images if member.index == image)
        scale_ratio = scene.maps[image].scale / anchor.scale
        anchor_pose = scene.rotations[image].copy(), scene.translations[image].copy()
        component_from_anchor = invert(anchor.rotation, anchor.translation)
        for member in component.images:
            if member.index != image:
                rotation, translation = compose(
                    (member.rotation, member.translation), component_from_anchor
                )
                pose = compose((rotation, scale_ratio * translation), anchor_pose)
                scene.register(member.index, *pose)
                scene.maps[member.index].set_scale(scale_ratio * member.scale)

    def _find_next_image(self) -> tuple[int, ScoredPose] | None:
        """Return the unregistered image with the best supported pose."""
        candidates = ~self.scene.registered
        best: tuple[int, ScoredPose] | None = None
        for image, best_match in rank_next_images(self.scene, self._scores, candidates):
            pose = self._estimate_pose(image, best_match)
            if pose and (best is None or pose.support > best[1].support):
                best = image, pose
        return best

    def _estimate_pose(self, image: int, best_match: int) -> ScoredPose | None:
        """Estimate the pose of an image, or reuse the last pose from the same reference images."""
        scene, options = self.scene, self._options
        references = find_local_bundle(scene, best_match, self._scores)
        if image not in self._poses or self._poses[image][0] != references:
            correspondences = find_correspondences(scene, image, references, options)
            poses = []
            if len(correspondences.keypoints):
                poses = self._pose_estimator.estimate_poses(correspondences, attempt=0)
            self._poses[image] = references, max(poses, key=lambda p: p.support, default=None)
        return self._poses[image][1]
