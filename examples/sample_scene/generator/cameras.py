"""Cameras, poses and the exact maps of a view; independent of Blender."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with square pixels and a centered principal point."""

    width: int = 640
    height: int = 480
    focal: float = 540.0

    @property
    def params(self) -> list[float]:
        """Return ``[fx, fy, cx, cy]`` in COLMAP pixels (first pixel at (0.5, 0.5))."""
        return [self.focal, self.focal, self.width / 2, self.height / 2]

    def halved(self) -> Camera:
        """Return the camera of the same view at half the size."""
        return Camera(self.width // 2, self.height // 2, self.focal / 2)

    def rays(self) -> Float64:
        """Compute (height, width, 3) rays through the pixel centers, z = 1."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        x, y = (u - self.width / 2) / self.focal, (v - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], -1)


@dataclass(frozen=True)
class Pose:
    """Camera pose, ``x_camera = rotation @ (x_world - centre)``; x right, y down, z forward."""

    rotation: Float64
    centre: Float64


@dataclass(frozen=True)
class Truth:
    """Exact maps of a view.

    z depth (h, w) in meters, 0 without a surface; unit normals (h, w, 3) in the camera frame that
    face the camera, 0 without a surface.
    """

    depth: Float64
    normals: Float64


def look(centre: Float64, heading_deg: float, pitch_deg: float, roll_deg: float) -> Pose:
    """Create a pose at ``centre`` from heading, pitch and roll in degrees; world z up.

    ``heading_deg`` turns from +x to +y, ``pitch_deg`` up, ``roll_deg`` about the optical axis.
    """
    heading, pitch, roll = np.radians([heading_deg, pitch_deg, roll_deg])
    level = np.array([np.cos(heading), np.sin(heading), 0])
    forward = np.cos(pitch) * level + [0, 0, np.sin(pitch)]
    right = np.array([level[1], -level[0], 0])
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    return Pose(np.stack([turned, np.cross(forward, turned), forward]), np.asarray(centre, float))
