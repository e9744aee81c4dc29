"""Rigs: cameras that move as one (COLMAP's rigs and frames)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mpsfm_core.data.arrays import Float64, Int64, Pose
from mpsfm_core.data.errors import DataError

MAX_ROTATION_DEVIATION = 1e-6
"""Largest entry of ``R @ R.T - I`` up to which a matrix ``R`` is accepted as a rotation."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras with constant relative poses, and their images (COLMAP's ``Rig`` and ``Frame``).

    If a relative pose is unknown, the mapper reconstructs the images without the rig first, and
    estimates all relative poses of the rig from this reconstruction.

    Examples:
        >>> left = np.eye(3), np.zeros(3)
        >>> right = np.eye(3), np.array([-0.1, 0.0, 0.0])
        >>> rig = Rig((left, right), (("left/1.jpg", "right/1.jpg"), ("left/2.jpg", None)))
        >>> rig.has_baseline
        True
    """

    sensor_from_rig: tuple[Pose | None, ...]
    """Pose of each sensor, as rotation (3, 3) and translation (3,) in meters, or None if the pose
    is unknown."""
    frames: tuple[tuple[str | None, ...], ...]
    """Name of the image of each sensor for each frame, None if the sensor has no image. A frame is
    the set of images that the rig takes at one moment."""
    is_estimated: bool = False
    """True if the relative poses are estimates. Bundle adjustment refines such poses, and their
    baseline does not determine the metric scale."""

    def __post_init__(self) -> None:
        for rotation, translation in filter(None, self.sensor_from_rig):
            if np.shape(rotation) != (3, 3) or np.shape(translation) != (3,):
                raise DataError(
                    "sensor_from_rig", "pose must be a rotation (3, 3), translation (3)"
                )
            deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
            is_rotation = deviation <= MAX_ROTATION_DEVIATION and np.linalg.det(rotation) > 0
            if not is_rotation or not np.isfinite(translation).all():
                raise DataError("sensor_from_rig", "pose must be a finite rigid transform")
        if any(len(frame) != len(self.sensor_from_rig) for frame in self.frames):
            raise DataError("frames", "a frame must have one image name, or None, for each sensor")

    @property
    def image_names(self) -> list[str]:
        """Names of all images that the cameras of the rig took, frame by frame."""
        return [name for frame in self.frames for name in frame if name is not None]

    @property
    def is_calibrated(self) -> bool:
        """True if the pose of every sensor is known or estimated."""
        return None not in self.sensor_from_rig

    @property
    def sensor_poses(self) -> tuple[Pose, ...]:
        """Pose ``sensor_from_rig`` of each sensor.

        Raises:
            ValueError: The pose of a sensor is unknown.
        """
        poses = tuple(pose for pose in self.sensor_from_rig if pose is not None)
        if len(poses) < len(self.sensor_from_rig):
            raise ValueError("the pose sensor_from_rig of a sensor is unknown")
        return poses

    @property
    def has_baseline(self) -> bool:
        """True if the centers of two sensors differ, and their distance is known."""
        if self.is_estimated or not self.is_calibrated:
            return False
        return bool(np.ptp(self.sensor_centers(), axis=0).max() > 0)

    def sensor_centers(self) -> Float64:
        """Return the camera centers (s, 3) of the sensors in the frame of the rig, in meters."""
        return np.array([-rotation.T @ translation for rotation, translation in self.sensor_poses])

    def subset(self, names: Collection[str]) -> Rig:
        """Return the rig restricted to the named images, without frames that have no image."""
        chosen = set(names)
        frames = (tuple(n if n in chosen else None for n in frame) for frame in self.frames)
        return replace(self, frames=tuple(frame for frame in frames if any(frame)))

    def renamed(self, names: Mapping[str, str]) -> Rig:
        """Return the rig with new image names; images that ``names`` lacks keep their name."""
        frames = (tuple(n and names.get(n, n) for n in frame) for frame in self.frames)
        return replace(self, frames=tuple(frames))

    def scaled(self, factor: float) -> Rig:
        """Return the rig with all translations multiplied by a factor."""
        sensors = tuple((rotation, factor * shift) for rotation, shift in self.sensor_poses)
        return replace(self, sensor_from_rig=sensors)


def find_frames(names: Sequence[str], rigs: Iterable[Rig]) -> Int64:
    """Return the frame (n,) of each image, as the index of the first image of the frame.

    Args:
        names: Names of the images.
        rigs: Rigs of the images; an image without a rig is the only image of its frame.
    """
    row_of = {name: row for row, name in enumerate(names)}
    frame_of = np.arange(len(names), dtype=np.int64)
    for rig in rigs:
        for frame in rig.frames:
            rows = [row_of[name] for name in frame if name in row_of]
            frame_of[rows] = rows[:1]
    return frame_of
