"""Contract setup: the smallest architecture with random weights, written once per process."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_model

from mpsfm_core.testing import ContractSetup
from mpsfm_depth_anything_3.provider import as_published, network_of

SIDE = 56
"""Side of the network input in pixels."""
_SEED = 3
_ANGLE = 1.0
"""Fixed angle of view in radians, because random weights can predict angles without a tangent."""


def contract(folder: Path) -> ContractSetup:
    """Write random weights; the answers are valid but not accurate."""
    path = write_weights(folder / "model.safetensors")
    return ContractSetup(options={"weights": str(path), "resize": SIDE}, truth_source="none")


def write_weights(path: Path) -> Path:
    """Write random weights of the smallest network in the authors' file format."""
    with torch.random.fork_rng():
        torch.manual_seed(_SEED)
        network = network_of("da3-small")
        fov = network.cam_dec.fc_fov[0]
        torch.nn.init.constant_(fov.bias, _ANGLE)
        torch.nn.init.zeros_(fov.weight)
    save_model(as_published(network), str(path))
    return path
