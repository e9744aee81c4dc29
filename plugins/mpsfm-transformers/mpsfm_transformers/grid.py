"""Resizing of views to network images, and conversion of pixel positions."""

from __future__ import annotations

import numpy as np
import torch

from mpsfm_core import View
from mpsfm_core.data import Bool, Float64
from mpsfm_core.geometry import inside, resize_map, sample_nearest

_GRAY = (0.2989, 0.5870, 0.1140)
"""RGB weights of the gray conversion in the library's processors for SuperPoint."""


def network_size(view: View, longest: int | None, multiple: int) -> tuple[int, int]:
    """Compute a network size ``(width, height)`` of at most ``longest`` pixels.

    Images are not enlarged, and sides are rounded to multiples of ``multiple``, at least one.
    """
    scale = min(1.0, (longest or np.inf) / max(view.camera.size))
    width, height = (max(1, round(side * scale / multiple)) for side in view.camera.size)
    return width * multiple, height * multiple


def color_image(view: View, size: tuple[int, int], device: str) -> torch.Tensor:
    """Resize the image of a view to (1, 3, h, w) float32, RGB in [0, 1]."""
    resized = resize_map(view.image, *size) / np.float32(255)
    return torch.from_numpy(resized).permute(2, 0, 1)[None].contiguous().to(device)


def gray_image(view: View, size: tuple[int, int], device: str) -> torch.Tensor:
    """Resize a view to (1, 3, h, w) float32 in [0, 1], with three equal gray channels."""
    image = color_image(view, size, device)
    gray = (image * image.new_tensor(_GRAY)[:, None, None]).sum(1, keepdim=True)
    return gray.expand(-1, 3, -1, -1)


def is_inside_mask(view: View, xy: Float64) -> Bool:
    """Return which of the pixels (n, 2) are inside the view and its mask, (n,) bool."""
    ok = inside(xy, view.camera.size)
    return ok if view.mask is None else ok & sample_nearest(view.mask, xy)
