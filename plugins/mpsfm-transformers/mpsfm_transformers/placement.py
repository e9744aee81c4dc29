"""Position of a view on the input of a depth network.

The image processor of the model prepares the network input from a view. If the image processor pads
the view, or aligns corner pixels when resizing, the network output covers another area than the
view. The method :meth:`Prepared.cut` returns the part of the output that covers the view exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from transformers import AutoImageProcessor

from mpsfm_core import View
from mpsfm_core.data import Float32, Float64
from mpsfm_core.geometry import pixel_centers, resize_map, sample_bilinear
from mpsfm_transformers.hub import LoadedModel

_SMALLEST_SIDE = 32
"""Minimum side of an image in pixels, because image processors round sides down to multiples of up
to 32."""
_LARGEST_RATIO = 16
"""Maximum aspect ratio of an image. Image processors could resize images of larger aspect ratio to
a side of 0 pixels."""


@dataclass(frozen=True)
class Prepared:
    """Network input and the position of the view on it.

    ``pixels`` is the input tensor (1, 3, h, w). ``start`` and ``extent`` are the position and the
    size ``(x, y)`` of the view in input pixels. The center of the first input pixel is at 0.5.
    """

    pixels: torch.Tensor
    start: Float64
    extent: Float64
    aligned: bool = False
    """True if the outer output pixels are aligned with the centers of the outer input pixels."""

    def cut(self, value: Float32) -> Float32:
        """Cut the part of an output map (h, w) that covers the view."""
        have = np.array(value.shape[::-1], dtype=np.float64)
        size = np.array(tuple(self.pixels.shape[:-3:-1]), dtype=np.float64)
        if self.aligned:
            scale = (have - 1) / np.maximum(size - 1, 1)
            start, extent = (self.start - 0.5) * scale + 0.5, self.extent * scale
        else:
            start, extent = self.start * have / size, self.extent * have / size
        if (start == 0).all() and (extent == have).all():
            return value
        width, height = (max(1, round(side)) for side in extent)
        xy = start + pixel_centers(width, height).reshape(-1, 2) / (width, height) * extent
        cut, _ = sample_bilinear(value, np.ones(value.shape, dtype=np.bool_), xy)
        return cut.reshape(height, width).astype(np.float32)


Preparation = Callable[[View], Prepared]


def preparation_for(model: LoadedModel) -> Preparation:
    """Return a function that prepares network inputs from views for a model."""
    if model.network.config.model_type == "depth_pro":
        return _DepthProPreparation(model.preprocessor)
    processor = model.processor(AutoImageProcessor)
    if model.network.config.model_type == "zoedepth":
        return _ZoePreparation(processor)
    return _ByProcessor(processor)


class _ByProcessor:
    """Preparation that stretches the view to the network size, with optional padding."""

    def __init__(self, processor: Any) -> None:
        self._processor = processor

    def __call__(self, view: View) -> Prepared:
        image = _robust(view)
        pixels = self._pixels(image)
        size = np.array(tuple(pixels.shape[:-3:-1]))
        inner = size
        if self._processor.do_pad:
            inner = np.array(tuple(self._pixels(image, do_pad=False).shape[:-3:-1]))
        start = (size - inner) // 2
        return Prepared(pixels, start.astype(np.float64), inner.astype(np.float64))

    def _pixels(self, image: Any, **settings: bool) -> torch.Tensor:
        processed = self._processor(
            images=image, return_tensors="pt", input_data_format="channels_last", **settings
        )
        pixels: torch.Tensor = processed["pixel_values"]
        return pixels.float()


class _ZoePreparation(_ByProcessor):
    """Preparation of ZoeDepth: reflection padding, then resizing with aligned corners."""

    def __call__(self, view: View) -> Prepared:
        image = _robust(view)
        pixels = self._pixels(image)
        side = np.array(image.shape[1::-1], dtype=np.float64)
        padding = (np.sqrt(side / 2) * 3).astype(int) if self._processor.do_pad else 0 * side
        size = np.array(tuple(pixels.shape[:-3:-1]), dtype=np.float64)
        scale = (size - 1) / (side + 2 * padding - 1)
        return Prepared(pixels, (padding - 0.5) * scale + 0.5, side * scale, aligned=True)


class _DepthProPreparation:
    """Preparation of Depth Pro without torchvision: normalization, then bilinear stretching."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._size = settings["size"]["height"], settings["size"]["width"]
        self._mean, self._std = settings["image_mean"], settings["image_std"]

    def __call__(self, view: View) -> Prepared:
        rgb = torch.from_numpy(view.image.copy()).permute(2, 0, 1)[None].float() / 255
        mean, std = (rgb.new_tensor(v)[:, None, None] for v in (self._mean, self._std))
        pixels = torch.nn.functional.interpolate(
            (rgb - mean) / std, self._size, mode="bilinear", align_corners=False
        )
        extent = np.array(self._size[::-1], dtype=np.float64)
        return Prepared(pixels, np.zeros(2), extent)


def _robust(view: View) -> Any:
    """Return the image of a view, enlarged if too small or thin for an image processor."""
    longest = max(view.camera.size)
    smallest = max(_SMALLEST_SIDE, -(-longest // _LARGEST_RATIO))
    size = tuple(max(side, smallest) for side in view.camera.size)
    if size == view.camera.size:
        return view.image
    return np.rint(resize_map(view.image, *size)).astype(np.uint8)
