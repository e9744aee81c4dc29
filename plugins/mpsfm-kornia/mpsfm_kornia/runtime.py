"""Loading of weights, and conversion of positions between a view and the network input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool, Float64
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.geometry import inside, resize_map, sample_nearest, scale_pixels
from mpsfm_core.providers.weights import load_torch_state
from mpsfm_kornia.options import KNOWN_HASHES

_SMALLEST_SIDE = 32
"""Minimum side of the network input in pixels, because networks downsample by up to 32."""


def load_weights(context: ProviderContext, uri: str, sha256: str | None) -> dict[str, Any]:
    """Load the state dictionary of a weights file, and verify its hash if one is known."""
    return load_torch_state(context.resolve_weights(uri, sha256 or KNOWN_HASHES.get(uri)))


def load_state(module: torch.nn.Module, state: dict[str, Any], uri: str) -> None:
    """Load all learned tensors of a network, and switch the network to evaluation mode.

    Raises:
        WeightsError: The weights file lacks tensors of the network, or tensor shapes differ.
    """
    try:
        mismatch = module.load_state_dict(state, strict=False)
    except RuntimeError as error:  # shapes
        raise WeightsError(f"the weights file {uri} is for another network: {error}") from error
    learned = {name for name, _ in module.named_parameters()}
    learned |= {name for name, _ in module.named_buffers() if "running_" in name}
    if missing := sorted(learned & set(mismatch.missing_keys)):
        raise WeightsError(
            f"the weights file {uri} is for another network: {', '.join(missing[:3])} are missing"
        )
    module.eval()


def is_inside_mask(view: View, xy: Float64) -> Bool:
    """Return which of the pixels (n, 2) are inside of the view and of its mask, (n,) bool."""
    ok = inside(xy, view.camera.size)
    return ok if view.mask is None else ok & sample_nearest(view.mask, xy)


@dataclass(frozen=True)
class Grid:
    """Width and height of a view and of the network input for this view."""

    view: tuple[int, int]
    network: tuple[int, int]

    @classmethod
    def fit(cls, view: View, longest: int | None, multiple: int = 1) -> Grid:
        """Compute an input size of at most ``longest`` pixels, rounding sides down to multiples.

        Views are only enlarged to reach the minimum side of the networks.
        """
        scale = min(1.0, (longest or np.inf) / max(view.camera.size))
        sides = (round(side * scale) // multiple * multiple for side in view.camera.size)
        width, height = (max(side, _SMALLEST_SIDE) for side in sides)
        return cls(view.camera.size, (width, height))

    def image(self, view: View, device: str) -> torch.Tensor:
        """Resize the image of a view to (1, 3, h, w) float32, RGB in [0, 1]."""
        resized = resize_map(view.image, *self.network) / np.float32(255)
        return torch.from_numpy(resized).permute(2, 0, 1)[None].contiguous().to(device)

    def to_view(self, xy: Float64) -> Float64:
        """Convert pixels (n, 2) of the network input (first pixel at 0.5) to pixels of the view."""
        return scale_pixels(xy, self.network, self.view)

    @property
    def pixel_size(self) -> float:
        """Return the longer side of a network input pixel, in pixels of the view."""
        return max(v / n for v, n in zip(self.view, self.network, strict=True))
