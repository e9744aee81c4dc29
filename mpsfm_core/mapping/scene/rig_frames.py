"""Frames of the rigs of a scene: images with constant relative poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, Pose, Rig
from mpsfm_core.geometry import compose, invert
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.optimize.rig_basis import RigConstraint, measure_rig_scale


class RigFrames:
    """Frame and ``sensor_from_rig`` of each image of a mapping problem with n images.

    An image without a rig, or in a rig with an unknown relative pose, is the only image of its
    frame.

    Attributes:
        frame_of: (n,) int64 frame of each image.
        variable_sensor: (n,) int64 number of the sensor of each image whose ``sensor_from_rig``
            bundle adjustment refines, or -1. The first sensor of an estimated rig is constant.
        rotations: (n, 3, 3) float64 rotation of ``sensor_from_rig`` of each image.
        translations: (n, 3) float64 translation of ``sensor_from_rig`` of each image, in meters.
        scale: World units per meter, which converts the translations of rigs.
        scale_std: Posterior standard deviation of ``scale``, infinite before bundle adjustment.
    """

    def __init__(self, problem: MappingProblem) -> None:
        count = len(problem.images)
        self._rigs = tuple(rig for rig in problem.rigs if rig.is_calibrated)
        row_of = {image.name: row for row, image in enumerate(problem.images)}
        self.frame_of: Int64 = problem.frame_of_images(self._rigs)
        self.rotations: Float64 = np.tile(np.eye(3), (count, 1, 1))
        self.translations: Float64 = np.zeros((count, 3))
        self.scale = 1.0
        self.scale_std = np.inf
        self.variable_sensor: Int64 = np.full(count, -1, dtype=np.int64)
        num_variable = 0
        for rig in self._rigs:
            for frame in rig.frames:
                sensors = [(row_of[name], s) for s, name in enumerate(frame) if name in row_of]
                for row, sensor in sensors:
                    self.rotations[row], self.translations[row] = rig.sensor_poses[sensor]
                    if rig.is_estimated and sensor > 0:
                        self.variable_sensor[row] = num_variable + sensor - 1
            if rig.is_estimated:
                num_variable += len(rig.sensor_from_rig) - 1
        self._row_of = row_of
        self._images = {
            int(frame): np.flatnonzero(self.frame_of == frame)
            for frame in np.flatnonzero(np.bincount(self.frame_of, minlength=1) > 1)
        }

    @property
    def is_first(self) -> Bool:
        """Bool mask (n,) of the first image of each frame."""
        is_first: Bool = self.frame_of == np.arange(len(self.frame_of))
        return is_first

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

    def state_dict(self) -> StateDict:
        """Return the scale and the relative poses of the rigs for a snapshot or checkpoint."""
        return {
            "scale": self.scale,
            "scale_std": self.scale_std,
            "rotations": self.rotations.copy(),
            "translations": self.translations.copy(),
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the scale and the relative poses of the rigs."""
        self.scale, self.scale_std = state["scale"], state["scale_std"]
        self.rotations = state["rotations"].copy()
        self.translations = state["translations"].copy()

    def resume(self, rigs: Sequence[Rig]) -> None:
        """Load the relative poses of estimated rigs of a reconstruction."""
        for rig in rigs:
            for frame in rig.frames:
                for name, (rotation, translation) in zip(frame, rig.sensor_poses, strict=True):
                    if name in self._row_of:
                        rows = np.array([self._row_of[name]])
                        self.set_sensor_poses(rows, rotation[None], translation[None])

    def rigs(self) -> tuple[Rig, ...]:
        """Return the calibrated rigs with current relative poses, translations in world units."""
        return tuple(
            replace(rig, sensor_from_rig=self._sensor_poses(rig)).scaled(self.scale)
            for rig in self._rigs
        )

    def _sensor_poses(self, rig: Rig) -> tuple[Pose, ...]:
        """Return the current ``sensor_from_rig`` of a rig, with translations in meters."""
        poses = list(rig.sensor_poses)
        for frame in rig.frames:
            for sensor, name in enumerate(frame):
                if name in self._row_of:
                    row = self._row_of[name]
                    poses[sensor] = self.rotations[row].copy(), self.translations[row].copy()
        return tuple(poses)

    def set_sensor_poses(self, images: Int64, rotations: Float64, translations: Float64) -> None:
        """Set ``sensor_from_rig`` of variable sensors to those of images.

        Args:
            images: (m,) images.
            rotations: (m, 3, 3) rotation of ``sensor_from_rig`` of each image.
            translations: (m, 3) translation of ``sensor_from_rig`` of each image, in meters.
        """
        sensors, first = np.unique(self.variable_sensor[images], return_index=True)
        for sensor, row in zip(sensors, first, strict=True):
            if sensor >= 0:
                is_sensor = self.variable_sensor == sensor
                self.rotations[is_sensor] = rotations[row]
                self.translations[is_sensor] = translations[row]

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
        return pose if other == image else compose(self.relative_pose(image, other), pose)

    def relative_pose(self, image: int, other: int) -> Pose:
        """Return the pose ``other_from_image`` of two images of a frame, in world units."""
        if other == image:
            return np.eye(3), np.zeros(3)
        return compose(self._sensor_from_rig(other), invert(*self._sensor_from_rig(image)))

    def _sensor_from_rig(self, image: int) -> Pose:
        """Return ``sensor_from_rig`` of an image, with the translation in world units."""
        return self.rotations[image], self.scale * self.translations[image]

    def constrain(
        self, images: Int64, variable: Bool, *, refine_rigs: bool = False
    ) -> RigConstraint | None:
        """Return the constraint of a bundle adjustment problem, None if no frame has two images.

        Args:
            images: (m,) image of each row of the bundle adjustment problem.
            variable: (m,) bool mask of the images with a variable pose. A frame is variable if
                all of its images are variable.
            refine_rigs: Estimate the scale of the rigs, if a frame has a known baseline, and the
                relative poses of estimated rigs.
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
        if not refine_rigs:
            return constraint
        _, sensors = np.unique(
            np.append(self.variable_sensor[images], -1), return_inverse=True
        )  # without gaps between the numbers of sensors
        constraint = replace(constraint, variable_sensor=sensors[:-1] - 1)
        known = constraint.constant_sensors()
        has_baseline = measure_rig_scale(constraint, constraint.translations, known) is not None
        return replace(constraint, variable_scale=has_baseline)

    def measure_scale(self, images: Int64, translations: Float64) -> float | None:
        """Measure world units per meter from the poses of images, None without a baseline.

        Args:
            images: (m,) images with known poses.
            translations: (m, 3) translation of ``cam_from_world`` of each image.
        """
        constraint = self.constrain(images, np.ones(len(images), dtype=np.bool_), refine_rigs=True)
        if constraint is None:
            return None
        known = constraint.constant_sensors()
        scale = measure_rig_scale(constraint, translations, known)
        return measure_rig_scale(constraint, translations) if scale is None else scale
