"""Cameras, poses and exact depth and normal maps of a view, independent of Blender."""

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
        """Compute camera-frame rays through the pixel centers, (height, width, 3) with z = 1."""
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
    """Exact depth and normal maps of a rendered view.

    Depth (h, w) is along z in meters. Normals (h, w, 3) are unit vectors in the camera frame that
    face the camera. Depth and normals are 0 for pixels without a surface.
    """

    depth: Float64
    normals: Float64


def look(centre: Float64, heading_deg: float, pitch_deg: float, roll_deg: float) -> Pose:
    """Create a camera pose at ``centre`` from heading, pitch and roll in degrees; world z is up.

    ``heading_deg`` rotates from world +x to +y, ``pitch_deg`` upward, ``roll_deg`` about the
    optical axis.
    """
    heading, pitch, roll = np.radians([heading_deg, pitch_deg, roll_deg])
    level = np.array([np.cos(heading), np.sin(heading), 0])
    forward = np.cos(pitch) * level + [0, 0, np.sin(pitch)]
    right = np.array([level[1], -level[0], 0])
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    return Pose(np.stack([turned, np.cross(forward, turned), forward]), np.asarray(centre, float))
