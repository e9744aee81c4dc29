"""Images as networks see them, and where their pixels lie in the view."""

from __future__ import annotations

import numpy as np
import torch

from mpsfm_core import View
from mpsfm_core.data import Bool, Float64
from mpsfm_core.geometry import inside, resize_map, sample_nearest

_GRAY = (0.2989, 0.5870, 0.1140)
"""As the library's processors of SuperPoint and its matchers, with the weights' training."""


def network_size(view: View, longest: int | None, multiple: int) -> tuple[int, int]:
    """``(width, height)``: at most ``longest`` pixels long, never enlarged, sides rounded to
    multiples (and one multiple at least)."""
    scale = min(1.0, (longest or np.inf) / max(view.camera.size))
    width, height = (max(1, round(side * scale / multiple)) for side in view.camera.size)
    return width * multiple, height * multiple


def color_image(view: View, size: tuple[int, int], device: str) -> torch.Tensor:
    """The resized view, (1, 3, h, w) float32, RGB in [0, 1]."""
    resized = resize_map(view.image, *size) / np.float32(255)
    return torch.from_numpy(resized).permute(2, 0, 1)[None].contiguous().to(device)


def gray_image(view: View, size: tuple[int, int], device: str) -> torch.Tensor:
    """The resized view, (1, 3, h, w) float32 in [0, 1], with the same gray in all channels."""
    image = color_image(view, size, device)
    gray = (image * image.new_tensor(_GRAY)[:, None, None]).sum(1, keepdim=True)
    return gray.expand(-1, 3, -1, -1)


def usable(view: View, xy: Float64) -> Bool:
    """Which pixels (n, 2) lie in the view and in its mask."""
    ok = inside(xy, view.camera.size)
    return ok if view.mask is None else ok & sample_nearest(view.mask, xy)
