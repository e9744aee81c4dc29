"""Pinhole cameras and undistorted views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.arrays import Bool, Float64, UInt8, require_array
from mpsfm_core.data.errors import DataError


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an undistorted view (COLMAP's PINHOLE model)."""

    width: int
    """Columns in pixels."""
    height: int
    """Rows in pixels."""
    fx: float
    """Focal length along x in pixels."""
    fy: float
    """Focal length along y in pixels."""
    cx: float
    """Principal point in COLMAP pixels; the center of a W x H view is ``(W / 2, H / 2)``."""
    cy: float
    """Principal point along y in COLMAP pixels."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise DataError(
                "camera", f"width and height must be positive, got {self.width}x{self.height}"
            )
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0):
            raise DataError("camera", "intrinsics must be finite and focal lengths positive")
        if self.fy <= 0:
            raise DataError("camera", "focal lengths must be positive")

    @property
    def matrix(self) -> Float64:
        """Calibration matrix K of the pinhole camera, (3, 3) float64."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=np.float64
        )

    @property
    def params(self) -> Float64:
        """Intrinsics ``(fx, fy, cx, cy)`` in pixels, (4,) float64."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    @property
    def size(self) -> tuple[int, int]:
        """Size ``(width, height)`` of the view in pixels."""
        return self.width, self.height

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Scale the intrinsics to a resized view of another width and height in pixels."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)


MapOrientation = Literal["auto", "stored", "upright"]
"""Orientation of depth, normal or mask files: the axes of the image before EXIF rotation
(``stored``), after EXIF rotation (``upright``), or chosen by aspect ratio (``auto``)."""


@dataclass(frozen=True, eq=False)
class View:
    """Undistorted image, the input of networks that predict depth, normals or features."""

    name: str
    """Path of the original image below the images folder, with forward slashes."""
    image: UInt8
    """(H, W, 3) uint8 RGB pixels of the view."""
    camera: PinholeCamera
    """Intrinsics of the view."""
    mask: Bool | None = field(default_factory=lambda: None)
    """(H, W) bool, False at pixels outside the undistorted image or masked by the user (None for
    all True)."""
    orientation: int = 1
    """EXIF orientation that was applied to the original image, 1 to 8. A provider needs the
    orientation to read depth, normal or mask files that are stored without the EXIF rotation."""

    def __post_init__(self) -> None:
        height, width = self.camera.height, self.camera.width
        require_array(self, "image", np.uint8, (height, width, 3))
        if self.mask is not None:
            require_array(self, "mask", np.bool_, (height, width))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Decode the image and the mask of a view of :func:`defer_decoding`."""
            decode = vars(self).get("_decode")
            if decode is None or name not in ("image", "mask"):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            decoded = decode()
            vars(self).update(image=decoded.image, mask=decoded.mask)
            return getattr(decoded, name)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def defer_decoding(
    name: str, camera: PinholeCamera, orientation: int, decode: Callable[[], View]
) -> View:
    """Return a view whose image and mask are decoded when they are first used.

    Args:
        name: Path of the original image below the images folder.
        camera: Intrinsics of the view.
        orientation: EXIF orientation of the original image, 1 to 8.
        decode: Function that returns the decoded view.
    """
    view = object.__new__(View)
    vars(view).update(name=name, camera=camera, orientation=orientation, _decode=decode)
    return view


def dot_with_rays(camera: PinholeCamera, normals: NDArray[Any]) -> Float64:
    """Compute dot products of normals with the unit rays through their pixels.

    A normal faces the camera if its dot product with the ray is negative.

    Args:
        camera: Intrinsics of the view.
        normals: (h, w, 3) normals in the camera frame, on a grid of any size over the whole view.

    Returns:
        (h, w) float64.
    """
    height, width = normals.shape[:2]
    grid = camera.resized(width, height)
    x = (np.arange(width) + 0.5 - grid.cx) / grid.fx
    y = ((np.arange(height) + 0.5 - grid.cy) / grid.fy)[:, None]
    dot: Float64 = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
    return dot / np.sqrt(1 + x**2 + y**2)
