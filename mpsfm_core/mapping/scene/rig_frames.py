"""Frames of the rigs of a scene: images whose relative poses are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, Pose
from mpsfm_core.geometry import compose, invert
from mpsfm_core.optimize.rig_basis import RigConstraint, measure_rig_scale


class RigFrames:
    """Frame and ``sensor_from_rig`` of each image of a mapping problem with n images.

    An image without a rig is the only image of its frame.

    Attributes:
        frame_of: (n,) int64 frame of each image.
        rotations: (n, 3, 3) float64 rotation of ``sensor_from_rig`` of each image.
        translations: (n, 3) float64 translation of ``sensor_from_rig`` of each image, in meters.
        scale: World units per meter, which converts the translations of rigs.
        scale_std: Posterior standard deviation of ``scale``, infinite before bundle adjustment.
    """

    def __init__(self, problem: MappingProblem) -> None:
        count = len(problem.images)
        row_of = {image.name: row for row, image in enumerate(problem.images)}
        self.frame_of: Int64 = np.arange(count, dtype=np.int64)
        self.rotations: Float64 = np.tile(np.eye(3), (count, 1, 1))
        self.translations: Float64 = np.zeros((count, 3))
        self.scale = 1.0
        self.scale_std = np.inf
        for rig in problem.rigs:
            for frame in rig.frames:
                sensors = [(row_of[name], s) for s, name in enumerate(frame) if name in row_of]
                for row, sensor in sensors:
                    self.frame_of[row] = sensors[0][0]
                    self.rotations[row], self.translations[row] = rig.sensor_from_rig[sensor]
        self._images = {
            int(frame): np.flatnonzero(self.frame_of == frame)
            for frame in np.flatnonzero(np.bincount(self.frame_of, minlength=1) > 1)
        }

    @property
    def exist(self) -> bool:
        """True if any frame has several images."""
        return bool(self._images)

    def images_of(self, image: int) -> list[int]:
        """Return the given image, followed by the other images of its frame."""
        images = self._images.get(int(self.frame_of[image]))
        if images is None:
            return [image]
        return [image, *(int(k) for k in images if k != image)]

    def complete(self, images: list[int]) -> list[int]:
        """Return the given images, followed by the other images of their frames."""
        if not self._images:
            return images
        others = [other for image in images for other in self.images_of(image)]
        return list(dict.fromkeys([*images, *others]))

    def derive_pose(self, image: int, pose: Pose, other: int) -> Pose:
        """Return the pose of an image of a frame, from the pose of another image of the frame.

        Args:
            image: Image with a known pose.
            pose: Pose ``cam_from_world`` of ``image``.
            other: Image of the same frame.
        """
        frame_from_world = compose(invert(*self._sensor_from_rig(image)), pose)
        return compose(self._sensor_from_rig(other), frame_from_world)

    def _sensor_from_rig(self, image: int) -> Pose:
        """Return ``sensor_from_rig`` of an image, with the translation in world units."""
        return self.rotations[image], self.scale * self.translations[image]

    def constrain(
        self, images: Int64, variable: Bool, *, refine_scale: bool = False
    ) -> RigConstraint | None:
        """Return the constraint of a bundle adjustment problem, None if no frame has two images.

        Args:
            images: (m,) image of each row of the bundle adjustment problem.
            variable: (m,) bool mask of the images with a variable pose. A frame is variable if
                all of its images are variable.
            refine_scale: Estimate the scale of the rigs, if a frame has a baseline.
        """
        frames, rows = np.unique(self.frame_of[images], return_inverse=True)
        if len(frames) == len(images):
            return None
        is_constant = np.bincount(rows, ~variable, minlength=len(frames)) > 0
        constraint = RigConstraint(
            rows.astype(np.int64),
            self.rotations[images],
            self.translations[images],
            self.scale,
            variable_frame=~is_constant,
        )
        has_baseline = measure_rig_scale(constraint, constraint.translations) is not None
        return replace(constraint, variable_scale=refine_scale and has_baseline)

    def measure_scale(self, images: Int64, translations: Float64) -> float | None:
        """Measure world units per meter from the poses of images, None without a baseline.

        Args:
            images: (m,) images with known poses.
            translations: (m, 3) translation of ``cam_from_world`` of each image.
        """
        constraint = self.constrain(images, np.ones(len(images), dtype=np.bool_))
        return None if constraint is None else measure_rig_scale(constraint, translations)
