"""Pinhole cameras and undistorted views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.arrays import Bool, Float64, UInt8, require_array
from mpsfm_core.data.errors import DataError


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an undistorted view: size in pixels, focal lengths and principal point.

    ``cx, cy`` are in COLMAP pixels: the image centre of a W x H view is ``(W / 2, H / 2)``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise DataError("camera", f"size must be positive, got {self.width}x{self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0):
            raise DataError("camera", "intrinsics must be finite and focal lengths positive")
        if self.fy <= 0:
            raise DataError("camera", "focal lengths must be positive")

    @property
    def matrix(self) -> Float64:
        """The 3 x 3 calibration matrix K, float64."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=np.float64
        )

    @property
    def params(self) -> Float64:
        """``(fx, fy, cx, cy)``, float64 (4,)."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    @property
    def size(self) -> tuple[int, int]:
        """``(width, height)`` in pixels."""
        return self.width, self.height

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The same camera on a grid of another size (exact in the (0.5, 0.5) convention)."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)


@dataclass(frozen=True, eq=False)
class View:
    """One undistorted image as a provider sees it.

    ``name``: path of the original image below the images folder, with forward slashes.
    ``image``: (H, W, 3) uint8, RGB. ``mask``: (H, W) bool, True where the pixel may be used
    (False: outside of the undistorted area or masked by the user), or None for all True.
    """

    name: str
    image: UInt8
    camera: PinholeCamera
    mask: Bool | None = None

    def __post_init__(self) -> None:
        height, width = self.camera.height, self.camera.width
        require_array(self, "image", np.uint8, (height, width, 3))
        if self.mask is not None:
            require_array(self, "mask", np.bool_, (height, width))


def dot_with_rays(camera: PinholeCamera, normals: NDArray[Any]) -> Float64:
    """Dot products (h, w) of a map of vectors (h, w, 3) that covers the camera's view, on a grid
    of any size, with the unit rays through its pixels: negative where a normal faces the camera."""
    height, width = normals.shape[:2]
    grid = camera.resized(width, height)
    x = (np.arange(width) + 0.5 - grid.cx) / grid.fx
    y = ((np.arange(height) + 0.5 - grid.cy) / grid.fy)[:, None]
    along: Float64 = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
    return along / np.sqrt(1 + x**2 + y**2)
