"""RoMa with seeded random weights, for comparisons without published weights."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch

from mpsfm_vismatch.collection import provide_imports

COARSE, FINE = 560, 280
"""Image sides in pixels of RoMa's first and second pass. The published RoMa uses image sides of 560
and 864 pixels. If the first pass has another size than 560, RoMa versions differ in the radius of
the warp refinement.
"""


def network(roma_outdoor: Callable[..., Any], device: str = "cpu") -> Any:
    """Create the RoMa network, with random weights that are seeded by the tensor names."""
    options = {"coarse_res": COARSE, "upsample_res": FINE, "use_custom_corr": False}
    known = inspect.signature(roma_outdoor).parameters
    with patch.object(torch.nn.Module, "load_state_dict"):  # there is no weights file to load
        made = roma_outdoor(
            device=device,
            weights={},
            dinov2_weights={},
            **{name: value for name, value in options.items() if name in known},
        )
    state = made.state_dict()
    state |= {f"dinov2.{n}": t for n, t in made.encoder.dinov2_vitl14[0].state_dict().items()}
    for name, tensor in state.items():
        if tensor.is_floating_point() and not name.endswith("running_var"):
            generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
            drawn = torch.randn(tensor.shape, generator=generator)
            size = tensor.shape[1:].numel() if tensor.ndim > 1 else 400
            tensor.copy_(drawn / size**0.5 + (tensor.ndim == 1 and name.endswith("weight")))
    return made.eval()


class Matcher:
    """Matcher with the interface of vismatch that runs vismatch's copy of the RoMa code."""

    __module__ = "vismatch.im_models.roma"

    def __init__(self, device: str = "cpu", max_num_keypoints: int = 2048) -> None:
        from vismatch.im_models.roma import roma_outdoor

        with provide_imports(self):
            self.roma_model = network(roma_outdoor, device)
