"""Resizing, padding and cropping of a view to the network input, and the inverse mapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpsfm_core import PinholeCamera
from mpsfm_core.data import Float32, Float64, UInt8
from mpsfm_core.geometry import pixel_centers, sample_bilinear, scale_pixels
from mpsfm_onnx.description import FixedSize, ImageInput, SideSize

_INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}


@dataclass(frozen=True)
class Canvas:
    """Position of the resized image on the network input, in pixels.

    ``size`` is the ``(width, height)`` of the network input, and ``image`` that of the resized
    image. ``offset`` (x, y) is the upper left corner of the resized image on the network input.
    The offset is negative where the network input crops the resized image.
    """

    size: tuple[int, int]
    image: tuple[int, int]
    offset: tuple[int, int]

    @classmethod
    def plan(cls, rule: FixedSize | SideSize, view: tuple[int, int]) -> Canvas:
        """Compute the position of a view of ``(width, height)`` pixels on the network input."""
        if isinstance(rule, FixedSize):
            size = (rule.width, rule.height)
            scale = min(s / v for s, v in zip(size, view, strict=True))
            if rule.fit == "stretch":
                image = size
            elif rule.rounding == "down":
                image = max(1, int(view[0] * scale)), max(1, int(view[1] * scale))
            else:
                image = _scaled(view, scale)
        else:
            scale = rule.side / (max(view) if rule.mode == "longest" else min(view))
            if not rule.enlarge:
                scale = min(scale, 1.0)
            image = _scaled(view, scale)
            step = rule.multiple_of
            if rule.fit == "stretch":
                image = size = _scaled(view, scale, step)
            elif rule.fit == "pad":
                size = (-(-image[0] // step) * step, -(-image[1] // step) * step)
            else:
                size = (max(image[0] // step, 1) * step, max(image[1] // step, 1) * step)
        left, top = (int((s - i) / 2) for s, i in zip(size, image, strict=True))
        return cls(size, image, (left, top))

    def paint(self, image: UInt8, rule: ImageInput) -> NDArray[Any]:
        """Create the input tensor (1, 3, h, w) or (1, h, w, 3) from an RGB image (H, W, 3)."""
        rgb = np.empty((self.size[1], self.size[0], 3), dtype=np.float32)
        rgb[:] = rule.pad_value
        (to_x, from_x), (to_y, from_y) = (self._overlap(axis) for axis in (0, 1))
        rgb[to_y, to_x] = _resize(image, self.image, rule.interpolation)[from_y, from_x]
        values = rgb if rule.channels == "RGB" else rgb[..., ::-1]
        mean, std = np.array([rule.mean, rule.std], dtype=np.float32)
        values = (values * np.float32(rule.scale) - mean) / std
        if rule.layout == "NCHW":
            values = values.transpose(2, 0, 1)
        return np.ascontiguousarray(values[None])

    def cut(self, planes: Float32) -> Float32:
        """Cut an output (h, w, c) of the whole network input to the part that covers the view.

        The returned map covers the view exactly, and is NaN where the network input crops the view.
        If the image border is not between two pixels of the network output, the output is sampled
        bilinearly.
        """
        height, width = planes.shape[:2]
        scale = (width / self.size[0], height / self.size[1])
        left, top = (o * s for o, s in zip(self.offset, scale, strict=True))
        across, down = (i * s for i, s in zip(self.image, scale, strict=True))
        edges = np.array([left, top, left + across, top + down])
        if np.abs(edges - np.rint(edges)).max() < 1e-6:
            x0, y0, x1, y1 = np.rint(edges).astype(int)
            around = ((max(-y0, 0), max(y1 - height, 0)), (max(-x0, 0), max(x1 - width, 0)), (0, 0))
            padded = np.pad(planes, around, constant_values=np.nan)
            return padded[max(y0, 0) :, max(x0, 0) :][: y1 - y0, : x1 - x0]
        columns, rows = max(1, round(across)), max(1, round(down))
        xy = pixel_centers(columns, rows) * (across / columns, down / rows) + (left, top)
        everywhere = np.ones((height, width), dtype=np.bool_)
        sampled = [
            np.where(ok, values, np.nan).reshape(rows, columns)
            for values, ok in (
                sample_bilinear(planes[..., c], everywhere, xy.reshape(-1, 2))
                for c in range(planes.shape[2])
            )
        ]
        return np.stack(sampled, axis=-1).astype(np.float32)

    def camera(self, camera: PinholeCamera) -> PinholeCamera:
        """Return the view's camera with intrinsics in pixels of the network input."""
        resized = camera.resized(*self.image)
        (width, height), (x, y) = self.size, self.offset
        return PinholeCamera(width, height, resized.fx, resized.fy, resized.cx + x, resized.cy + y)

    def from_view(self, xy: Float64, view: tuple[int, int]) -> Float64:
        """Convert pixels (n, 2) of a view of size ``(width, height)`` to network input pixels."""
        return scale_pixels(xy, view, self.image) + self.offset

    def to_view(self, xy: Float64, view: tuple[int, int]) -> Float64:
        """Convert network input pixels (n, 2) to pixels of a view of size ``(width, height)``."""
        return scale_pixels(xy - np.array(self.offset, dtype=np.float64), self.image, view)

    def _overlap(self, axis: int) -> tuple[slice, slice]:
        """Compute the range of the resized image along an axis, in input and in image pixels."""
        start = max(self.offset[axis], 0)
        stop = min(self.offset[axis] + self.image[axis], self.size[axis])
        return slice(start, stop), slice(start - self.offset[axis], stop - self.offset[axis])


def _scaled(size: tuple[int, int], scale: float, step: int = 1) -> tuple[int, int]:
    width, height = (max(1, round(side * scale / step)) * step for side in size)
    return width, height


def _resize(image: UInt8, size: tuple[int, int], interpolation: str) -> UInt8:
    shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    if interpolation in ("smooth-cubic", "lanczos"):
        lanczos = interpolation == "lanczos" and size[0] < image.shape[1]
        mode = Image.Resampling.LANCZOS if lanczos else Image.Resampling.BICUBIC
        smoothed: UInt8 = np.asarray(Image.fromarray(image).resize(size, mode))
        return smoothed
    if interpolation == "area":
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    else:
        mode = _INTERPOLATION[interpolation]
    resized: UInt8 = cv2.resize(image, size, interpolation=mode)
    return resized
