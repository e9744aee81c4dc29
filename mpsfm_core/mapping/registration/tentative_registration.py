"""Images that no group holds, placed where their matches fit best; nothing confirms that."""

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
    find_local_bundle,
    rank_next_images,
)
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.scene.conversion import registered_image
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_image


def register_tentatively(
    reconstruction: Reconstruction,
    others: Sequence[Reconstruction],
    problem: MappingProblem,
    options: MapperOptions,
) -> Reconstruction:
    """The reconstruction with all further images that have matches to it, however doubtful.

    Again and again the image comes next whose pose is supported best, beside those placed before
    as well; an image of one of the ``others`` takes that whole group along. They see no points,
    and change neither the points nor the other poses.
    """
    completion = _Completion(reconstruction, others, problem, options)
    placed = completion.place_all()
    if not placed:
        return reconstruction
    in_metres = reconstruction.metric is not None and reconstruction.metric.trusted
    further = [
        replace(registered_image(completion.scene, image, 1.0, in_metres), confirmed=False)
        for image in placed
    ]
    images = sorted([*reconstruction.images, *further], key=lambda image: image.index)
    return replace(reconstruction, images=tuple(images))


class _Completion:
    """A scene like the finished one, to which images are added."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        others: Sequence[Reconstruction],
        problem: MappingProblem,
        options: MapperOptions,
    ) -> None:
        self.scene = Scene(problem, weigh_by_score=options.weigh_by_score)
        self._options = options.registration
        self._scores = compute_pair_scores(self.scene, options.registration.next_view)
        self._triangulation = options.triangulation
        self._refiner = Refiner(self.scene, options, self._scores)
        self._search = AbsolutePoseEstimator(self.scene, self._refiner, options)
        self._found: dict[int, tuple[list[int], ScoredPose | None]] = {}
        self._groups = {image.index: group for group in others for image in group.images}
        self._scale = float(np.median([image.scale for image in reconstruction.images]))
        self.scene.resume(reconstruction)

    def place_all(self) -> list[int]:
        """Place one image or group after the other; the images placed."""
        before = self.scene.registered.copy()
        while best := self._best():
            image, pose = best
            self._place(image, pose)
            if image in self._groups:
                self._place_beside(image, self._groups[image])
        return [int(image) for image in np.flatnonzero(self.scene.registered & ~before)]

    def _place(self, image: int, pose: ScoredPose) -> None:
        """Register an image and scale its prior to the points that it may see."""
        scene, depth_map = self.scene, self.scene.maps[image]
        before = scene.snapshot()
        scene.register(image, pose.rotation, pose.translation)
        triangulate_image(scene, image, self._triangulation)
        self._refiner.estimate_scale(image, self._found[image][0])
        scale = depth_map.scale if depth_map.active else self._scale
        scene.restore(before)
        scene.register(image, pose.rotation, pose.translation)
        depth_map.set_scale(scale)

    def _place_beside(self, image: int, group: Reconstruction) -> None:
        """Register the other images of a placed image's group as they lie to it."""
        scene = self.scene
        (own,) = (member for member in group.images if member.index == image)
        growth = scene.maps[image].scale / own.scale
        placed = scene.rotations[image].copy(), scene.translations[image].copy()
        inverse = invert(own.rotation, own.translation)
        for member in group.images:
            if member.index != image:
                turn, step = compose((member.rotation, member.translation), inverse)
                scene.register(member.index, *compose((turn, growth * step), placed))
                scene.maps[member.index].set_scale(growth * member.scale)

    def _best(self) -> tuple[int, ScoredPose] | None:
        """The image whose pose is supported best."""
        candidates = ~self.scene.registered
        best: tuple[int, ScoredPose] | None = None
        for image, reference in rank_next_images(
            self.scene, self._scores, candidates, self._options
        ):
            pose = self._pose(image, reference)
            if pose and (best is None or pose.support > best[1].support):
                best = image, pose
        return best

    def _pose(self, image: int, reference: int) -> ScoredPose | None:
        """The best pose beside some images; found once as long as these are the same."""
        scene, options = self.scene, self._options
        references = find_local_bundle(scene, reference, options.num_neighbors, self._scores)
        if image not in self._found or self._found[image][0] != references:
            found = find_correspondences(scene, image, references, options)
            poses = (
                self._search.estimate_poses(image, found, attempt=0) if len(found.keypoints) else []
            )
            self._found[image] = references, max(poses, key=lambda p: p.support, default=None)
        return self._found[image][1]
