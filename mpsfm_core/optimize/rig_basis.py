"""Bundle adjustment with one pose per frame of a rig.

The images of a frame have the poses ``image_from_world = sensor_from_rig * frame_from_world``, with
``sensor_from_rig = (S, k s)``. ``k`` is the scale of the rig, in world units per meter. A step
``(w, u)`` of the frame, ``R' = exp(w) R`` and ``t' = t + u``, is the step ``(S w, S u)`` of the
image. A step ``c`` of the scale ``k`` moves the image by ``c s``. Steps of images are therefore
linear in steps of frames::

    delta_images = B @ delta_frames

The reduced camera system ``H`` of the images gives the system ``B.T @ H @ B`` of the frames. ``B``
is constant, and the images of a frame keep their relative poses exactly.

If bundle adjustment estimates a ``sensor_from_rig``, its step ``(a, b)``, ``S' = exp(a) S`` and
``(k s)' = k s + b``, adds ``(a, a x (S t) + b)`` to the step of the image, with the translation
``t`` of the frame. ``B`` then depends on the poses, and :meth:`RigConstraint.retract` composes the
poses of images from those of frames and sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.data.errors import DataError
from mpsfm_core.geometry import camera_center
from mpsfm_core.optimize import bundle_kernels as kernels

_POSE = 6
"""Number of parameters of a pose."""
_MAX_DEVIATION = 1e-6
"""Largest deviation of initial poses from the relative poses of the rig, relative to the largest
translation."""


@dataclass(frozen=True, eq=False)
class RigConstraint:
    """Relative poses of the n images of a bundle adjustment problem with f frames."""

    frame_of_image: Int64
    """(n,) index of the frame of each image."""
    rotations: Float64
    """(n, 3, 3) rotation of ``sensor_from_rig`` of each image."""
    translations: Float64
    """(n, 3) translation of ``sensor_from_rig`` of each image, in meters."""
    scale: float = 1.0
    """Scale of the rig, in world units per meter."""
    variable_scale: bool = False
    """True if bundle adjustment estimates the scale of the rig."""
    variable_frame: Bool | None = None
    """(f,) bool, True for frames with a variable pose (None makes all frames variable)."""
    variable_sensor: Int64 | None = None
    """(n,) number of the sensor of each image whose ``sensor_from_rig`` is estimated, starting at
    0, or -1 for a constant ``sensor_from_rig`` (None makes all constant). The scale of the rig does
    not change the translation of these sensors."""

    @property
    def num_variable_sensors(self) -> int:
        """Number of sensors whose ``sensor_from_rig`` is estimated."""
        return 0 if self.variable_sensor is None else int(self.variable_sensor.max(initial=-1)) + 1

    def constant_sensors(self) -> Bool:
        """Return a bool mask (n,) of the images with a constant ``sensor_from_rig``."""
        if self.variable_sensor is None:
            return np.ones(len(self.frame_of_image), dtype=np.bool_)
        return self.variable_sensor < 0

    @property
    def fixes_scale(self) -> bool:
        """True if a constant baseline determines the scale of the world."""
        return not self.variable_scale and bool(self.translations[self.constant_sensors()].any())

    def frame_poses(self, rotations: Float64, translations: Float64) -> tuple[Float64, Float64]:
        """Return the rotations (n, 3, 3) and translations (n, 3) of ``frame_from_world``.

        Args:
            rotations: (n, 3, 3) rotation of ``cam_from_world`` of each image.
            translations: (n, 3) translation of ``cam_from_world`` of each image.
        """
        inverse = self.rotations.transpose(0, 2, 1)
        shifts = translations - self.scale * self.translations
        return inverse @ rotations, np.einsum("nij,nj->ni", inverse, shifts)

    def variable_frames(self) -> Bool:
        """Return a bool mask (f,) of the frames with a variable pose."""
        count = int(self.frame_of_image.max(initial=-1)) + 1
        if self.variable_frame is None:
            return np.ones(count, dtype=np.bool_)
        return self.variable_frame

    def variable_images(self) -> Bool:
        """Return a bool mask (n,) of the images with a variable pose."""
        variable: Bool = self.variable_frames()[self.frame_of_image] | ~self.constant_sensors()
        if self.variable_scale:
            variable = variable | (self.translations != 0).any(axis=1)
        return variable

    def check(self, rotations: Float64, translations: Float64) -> None:
        """Check the shapes of the constraint, and that poses of images fulfill the constraint.

        Raises:
            DataError: An array has a wrong shape, or poses differ from the rig.
        """
        count = len(rotations)
        shapes = self.frame_of_image.shape, self.rotations.shape, self.translations.shape
        if shapes != ((count,), (count, 3, 3), (count, 3)):
            raise DataError("rig", "arrays must have one row for each image")
        if not self.scale > 0:
            raise DataError("rig", "scale must be positive")
        _, first, rows = np.unique(self.frame_of_image, return_index=True, return_inverse=True)
        if len(first) != len(self.variable_frames()):
            raise DataError("rig", "every frame must have an image")
        of_frame = self.frame_poses(rotations, translations)
        limit = _MAX_DEVIATION * max(1.0, float(np.abs(translations).max(initial=0.0)))
        for poses in of_frame:
            if np.abs(poses - poses[first[rows]]).max(initial=0.0) > limit:
                raise DataError("rig", "initial poses differ from the relative poses of the rig")

    def retract(
        self, rotations: Float64, translations: Float64, basis: RigBasis, steps: Float64
    ) -> tuple[RigConstraint, Float64, Float64]:
        """Apply steps of frames, sensors and scale, which keep the relative poses exactly.

        Args:
            rotations: (n, 3, 3) rotation of ``cam_from_world`` of each image.
            translations: (n, 3) translation of ``cam_from_world`` of each image.
            basis: Basis of the reduced camera system at these poses.
            steps: (e,) steps of the parameters of the basis.

        Returns:
            The updated rig, and rotations (n, 3, 3) and translations (n, 3) of the images.
        """
        turns, shifts = self.frame_poses(rotations, translations)
        of_frame = np.zeros((len(self.variable_frames()), _POSE))
        of_frame[self.variable_frames()] = steps[: _POSE * basis.num_frames].reshape(-1, _POSE)
        of_frame = of_frame[self.frame_of_image]
        turns = Rotation.from_rotvec(of_frame[:, :3]).as_matrix() @ turns
        shifts = shifts + of_frame[:, 3:]
        scale = self.scale
        if basis.scale_column is not None:
            scale += float(steps[basis.scale_column])
        constant = self.constant_sensors()
        of_sensor = np.zeros((len(constant), _POSE))
        if basis.sensor_column is not None and self.variable_sensor is not None:
            by_sensor = steps[basis.sensor_column :].reshape(-1, _POSE)
            of_sensor[~constant] = by_sensor[self.variable_sensor[~constant]]
        sensors = Rotation.from_rotvec(of_sensor[:, :3]).as_matrix() @ self.rotations
        offsets = np.where(constant[:, None], scale, self.scale) * self.translations
        offsets += of_sensor[:, 3:]
        rig = replace(
            self,
            rotations=sensors,
            translations=np.where(constant[:, None], self.translations, offsets / scale),
            scale=scale,
        )
        moved = np.einsum("nij,nj->ni", sensors, shifts) + offsets
        return rig, sensors @ turns, moved

    def find_gauge(self, anchor: int, rotations: Float64, translations: Float64) -> tuple[int, int]:
        """Return the frame and pose parameter to keep constant, which fixes the scale gauge.

        Args:
            anchor: Image of the frame with the constant translation coordinate.
            rotations: (n, 3, 3) rotation of ``cam_from_world`` of each image.
            translations: (n, 3) translation of ``cam_from_world`` of each image.

        Raises:
            DataError: The frame of the anchor is constant, or all frames are variable.
        """
        variable = self.variable_frames()[self.frame_of_image]
        if not (0 <= anchor < len(variable) and variable[anchor]) or variable.all():
            raise DataError(
                "scale_anchor",
                "scale anchor must be an image of a variable frame, and a frame must be constant",
            )
        turns, shifts = self.frame_poses(rotations, translations)
        first = int(np.argmin(variable))
        center = camera_center(turns[first], shifts[first])
        offset = turns[anchor] @ center + shifts[anchor]
        return int(self.frame_of_image[anchor]), 3 + int(np.argmax(np.abs(offset)))


def measure_rig_scale(
    rig: RigConstraint, translations: Float64, used: Bool | None = None
) -> float | None:
    """Measure the scale of a rig from poses of images, by linear least squares over all frames.

    Args:
        rig: Relative poses and frames of the images.
        translations: (n, 3) translation of ``cam_from_world`` of each image.
        used: (n,) bool mask of the images to use (None uses all images).

    Returns:
        World units per meter, or None if no frame has images with different camera centers.
    """
    in_rig = np.einsum("nji,nj->ni", rig.rotations, translations)
    offsets = np.einsum("nji,nj->ni", rig.rotations, rig.translations)
    frames = rig.frame_of_image
    if used is not None:
        in_rig, offsets, frames = in_rig[used], offsets[used], frames[used]
    offsets = _subtract_frame_means(offsets, frames)
    energy = float((offsets**2).sum())
    if energy <= 0:
        return None
    return float((offsets * _subtract_frame_means(in_rig, frames)).sum()) / energy


def _subtract_frame_means(values: Float64, frames: Int64) -> Float64:
    """Subtract from each row (n, 3) the mean of its frame."""
    counts = np.bincount(frames)
    sums = np.stack([np.bincount(frames, column) for column in values.T], axis=1)
    residuals: Float64 = values - (sums / np.maximum(counts, 1)[:, None])[frames]
    residuals[np.abs(residuals) < 1e-12 * max(1.0, float(np.abs(values).max(initial=0)))] = 0.0
    return residuals


class RigBasis(NamedTuple):
    """Linear map from steps of frames to steps of images."""

    matrix: csr_matrix
    """(d, e) sparse matrix from the e variable parameters with frames to the d parameters of the
    reduced camera system. The first ``6 * num_frames`` columns are the poses of frames."""
    frame_of_slot: Int64
    """(s,) position of the variable frame of each pose slot among the variable frames, or -1."""
    slot_from_frame: Float64
    """(s, 7, 6) blocks of the matrix that map the pose of a variable frame to each of its pose
    slots."""
    num_frames: int
    """Number of variable frames."""
    scale_column: int | None
    """Column of the scale of the rig, or None if the scale is constant."""
    sensor_column: int | None
    """First column of the poses of variable sensors, which are the last columns, or None."""

    @classmethod
    def build(
        cls,
        rig: RigConstraint,
        layout: kernels.ParameterLayout,
        gauge: tuple[int, int] | None,
        translations: Float64,
    ) -> RigBasis:
        """Build the linear map for the parameters of a bundle adjustment.

        Args:
            rig: Relative poses and frames of the images.
            layout: Layout of the parameters of the reduced camera system.
            gauge: Frame and pose parameter that is constant, or None.
            translations: (n, 3) translation of ``cam_from_world`` of each image.
        """
        size, num_slots = int(kernels.NUM_IMAGE_PARAMS), layout.num_poses
        variable = rig.variable_frames()
        position = np.where(variable, np.cumsum(variable) - 1, -1)
        images = np.flatnonzero(layout.pose_slot >= 0)
        slots = layout.pose_slot[images].astype(np.int64)
        frame_of_slot = np.full(num_slots, -1, dtype=np.int64)
        frame_of_slot[slots] = position[rig.frame_of_image[images]]
        num_frames = int(variable.sum())
        rows, columns, values = [], [], []
        moving = images[position[rig.frame_of_image[images]] >= 0]
        starts = size * layout.pose_slot[moving].astype(np.int64)
        frames = _POSE * position[rig.frame_of_image[moving]]
        for first in (0, 3):
            for i in range(3):
                for j in range(3):
                    rows.append(starts + first + i)
                    columns.append(frames + first + j)
                    values.append(rig.rotations[moving, i, j])
        next_column = _POSE * num_frames
        scaled = np.flatnonzero(layout.variable_scale)
        num_intrinsics = int(layout.intrinsic_slot.max(initial=-1)) + 1
        free = np.concatenate(
            [
                size * layout.pose_slot[scaled].astype(np.int64) + int(kernels.LOG_SCALE_IDX),
                size * num_slots + np.arange(num_intrinsics),
            ]
        )
        rows.append(free)
        columns.append(next_column + np.arange(len(free)))
        values.append(np.ones(len(free)))
        next_column += len(free)
        scale_column = None
        is_constant = rig.constant_sensors()[images]
        if rig.variable_scale:
            scale_column = next_column
            next_column += 1
            scaled_slots = slots[is_constant]
            for i in range(3):
                rows.append(size * scaled_slots + 3 + i)
                columns.append(np.full(len(scaled_slots), scale_column))
                values.append(rig.translations[images[is_constant], i])
        sensor_column = None
        if rig.variable_sensor is not None and rig.num_variable_sensors:
            sensor_column = next_column
            next_column += _POSE * rig.num_variable_sensors
            chosen = images[~is_constant]
            starts = size * slots[~is_constant]
            sensors = sensor_column + _POSE * rig.variable_sensor[chosen]
            levers = translations[chosen] - rig.scale * rig.translations[chosen]
            for i in range(_POSE):
                rows.append(starts + i)
                columns.append(sensors + i)
                values.append(np.ones(len(chosen)))
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # cross product a x levers
                rows += [starts + 3 + i, starts + 3 + i]
                columns += [sensors + j, sensors + k]
                values += [levers[:, k], -levers[:, j]]
        row, column, value = (np.concatenate(parts) for parts in (rows, columns, values))
        if gauge is not None:
            value = np.where(column == _POSE * position[gauge[0]] + gauge[1], 0.0, value)
        shape = (size * num_slots + num_intrinsics, next_column)
        matrix = csr_matrix((value, (row, column)), shape=shape)
        matrix.eliminate_zeros()
        slot_from_frame = np.zeros((num_slots, size, _POSE))
        for slot in np.flatnonzero(frame_of_slot >= 0):
            top, left = size * slot, _POSE * int(frame_of_slot[slot])
            block = matrix[top : top + _POSE, left : left + _POSE]
            slot_from_frame[slot, :_POSE] = block.toarray()
        return cls(matrix, frame_of_slot, slot_from_frame, num_frames, scale_column, sensor_column)

    def solve_dense(self, matrix: Float64, rhs: Float64) -> Float64:
        """Solve the reduced camera system for the parameters of the rig.

        Args:
            matrix: (d, d) reduced camera matrix with damping, of which the lower triangle is used.
            rhs: (d,) or (d, r) right side.

        Returns:
            (e,) or (e, r) steps, NaN if the matrix is not positive definite.
        """
        _, solution, info = lapack.dposv(self._project(matrix), self.matrix.T @ rhs, lower=1)
        steps: Float64 = solution if info == 0 else np.full_like(solution, np.nan)
        return steps

    def compute_scale_variance(self, matrix: Float64) -> float:
        """Compute the posterior variance of the scale of the rig, infinite if undetermined.

        Args:
            matrix: (d, d) reduced camera matrix, of which the lower triangle is used.
        """
        if self.scale_column is None:
            return np.inf
        unit = np.zeros(self.matrix.shape[1])
        unit[self.scale_column] = 1.0
        _, solution, info = lapack.dposv(self._project(matrix), unit, lower=1)
        return float(solution[self.scale_column]) if info == 0 else np.inf

    def _project(self, matrix: Float64) -> Float64:
        """Return ``B.T @ H @ B`` with ones on the diagonal of constant parameters."""
        full = np.tril(matrix) + np.tril(matrix, -1).T
        projected: Float64 = self.matrix.T @ (self.matrix.T @ full).T
        constant = np.flatnonzero(np.diagonal(projected) == 0)
        projected[constant, constant] = 1.0
        return projected

    def create_preconditioner(
        self, blocks: Float64, pairs: Int64, diagonal: Float64
    ) -> Callable[[Float64], Float64]:
        """Return the block-Jacobi preconditioner of the reduced system of the frames.

        Args:
            blocks: (b, 7, 7) blocks of the reduced camera matrix with damping. Blocks on the
                diagonal are symmetric.
            pairs: (b, 2) pose slots of each block.
            diagonal: (d,) diagonal of the reduced camera matrix with damping.
        """
        frame = self.frame_of_slot[pairs]
        same = np.flatnonzero((frame[:, 0] == frame[:, 1]) & (frame[:, 0] >= 0))
        first, second = pairs[same].T
        maps = self.slot_from_frame
        products = maps[first].transpose(0, 2, 1) @ blocks[same] @ maps[second]
        between = first != second
        products[between] += products[between].transpose(0, 2, 1)
        sums = np.zeros((self.num_frames, _POSE, _POSE))
        np.add.at(sums, frame[same, 0], products)
        frames, constant = np.nonzero(np.einsum("nii->ni", sums) <= 0)
        sums[frames, constant, constant] = 1.0
        inverse = np.linalg.inv(sums)
        num_pose = _POSE * self.num_frames
        scalar = (self.matrix.multiply(self.matrix).T @ diagonal)[num_pose:]
        scalar = np.where(scalar > 0, scalar, 1.0)

        def precondition(x: Float64) -> Float64:
            poses = np.einsum("nab,nb->na", inverse, x[:num_pose].reshape(-1, _POSE))
            return np.concatenate([poses.ravel(), x[num_pose:] / scalar])

        return precondition
