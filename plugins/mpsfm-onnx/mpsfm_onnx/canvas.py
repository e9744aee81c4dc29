"""From a view to the network's canvas and back: resizing, padding, and undoing both exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core import PinholeCamera
from mpsfm_core.data import Float32, UInt8
from mpsfm_core.geometry import pixel_centers, sample_bilinear
from mpsfm_onnx.description import FixedSize, ImageInput, SideSize

_INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}


@dataclass(frozen=True)
class Canvas:
    """Where the resized image lies on the network's input, all in pixels.

    ``size``: of the canvas; ``image``: of the resized image; ``offset``: of its upper left corner.
    Each is ``(width, height)``.
    """

    size: tuple[int, int]
    image: tuple[int, int]
    offset: tuple[int, int]

    @classmethod
    def plan(cls, rule: FixedSize | SideSize, view: tuple[int, int]) -> Canvas:
        """The canvas for a view of ``(width, height)`` pixels."""
        if isinstance(rule, FixedSize):
            size = (rule.width, rule.height)
            scale = min(s / v for s, v in zip(size, view, strict=True))
            image = size if rule.fit == "stretch" else _scaled(view, scale)
        else:
            scale = rule.side / (max(view) if rule.mode == "longest" else min(view))
            if not rule.enlarge:
                scale = min(scale, 1.0)
            image = _scaled(view, scale)
            step = rule.multiple_of
            if rule.fit == "stretch":
                image = size = _scaled(view, scale, step)
            else:
                size = (-(-image[0] // step) * step, -(-image[1] // step) * step)
        offset = ((size[0] - image[0]) // 2, (size[1] - image[1]) // 2)
        return cls(size, image, offset)

    def paint(self, image: UInt8, rule: ImageInput) -> NDArray[Any]:
        """The input tensor with its batch dimension, for an (H, W, 3) RGB image."""
        rgb = np.empty((self.size[1], self.size[0], 3), dtype=np.float32)
        rgb[:] = rule.pad_value
        (x, y), (width, height) = self.offset, self.image
        rgb[y : y + height, x : x + width] = _resize(image, self.image, rule.interpolation)
        values = rgb if rule.channels == "RGB" else rgb[..., ::-1]
        if rule.dtype != "uint8":
            mean, std = np.array([rule.mean, rule.std], dtype=np.float32)
            values = (values * np.float32(rule.scale) - mean) / std
        else:
            values = np.rint(values)
        if rule.layout == "NCHW":
            values = values.transpose(2, 0, 1)
        return np.ascontiguousarray(values[None], dtype=rule.dtype)

    def cut(self, planes: Float32) -> Float32:
        """The part of an output (h, w, c) that shows the view; the output covers the canvas.

        The result covers the view exactly. Where the image's border does not fall between two
        output pixels, it is sampled bilinearly at half-pixel-correct positions.
        """
        height, width = planes.shape[:2]
        scale = (width / self.size[0], height / self.size[1])
        left, top = (o * s for o, s in zip(self.offset, scale, strict=True))
        across, down = (i * s for i, s in zip(self.image, scale, strict=True))
        edges = np.array([left, top, left + across, top + down])
        if np.abs(edges - np.rint(edges)).max() < 1e-6:
            x0, y0, x1, y1 = np.rint(edges).astype(int)
            return planes[y0:y1, x0:x1]
        columns, rows = max(1, round(across)), max(1, round(down))
        xy = pixel_centers(columns, rows) * (across / columns, down / rows) + (left, top)
        everywhere = np.ones((height, width), dtype=np.bool_)
        sampled = [
            sample_bilinear(planes[..., c], everywhere, xy.reshape(-1, 2))[0].reshape(rows, columns)
            for c in range(planes.shape[2])
        ]
        return np.stack(sampled, axis=-1).astype(np.float32)

    def focal(self, camera: PinholeCamera) -> float:
        """Mean focal length of the resized image, in its pixels."""
        resized = camera.resized(*self.image)
        return (resized.fx + resized.fy) / 2


def _scaled(size: tuple[int, int], scale: float, step: int = 1) -> tuple[int, int]:
    width, height = (max(1, round(side * scale / step)) * step for side in size)
    return width, height


def _resize(image: UInt8, size: tuple[int, int], interpolation: str) -> UInt8:
    if interpolation == "area":
        shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    else:
        mode = _INTERPOLATION[interpolation]
    resized: UInt8 = cv2.resize(image, size, interpolation=mode)
    return resized
