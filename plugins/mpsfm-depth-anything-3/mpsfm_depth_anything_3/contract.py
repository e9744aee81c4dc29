"""Random weights of the smallest Depth Anything 3 network, for the provider contract tests."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_model

from mpsfm_core.testing import ContractSetup
from mpsfm_depth_anything_3.provider import as_published, network_of

SIDE = 56
"""Longer side of the network input in pixels in the contract tests."""
_SEED = 3
_ANGLE = 1.0
"""Angle of view in radians that the test network always predicts. Random weights could predict
angles whose tangent is undefined."""


def contract(folder: Path) -> ContractSetup:
    """Write a Depth Anything 3 with random weights, whose predictions are valid but inaccurate."""
    path = write_weights(folder / "model.safetensors")
    return ContractSetup(options={"weights": str(path), "resize": SIDE}, truth_source="none")


def write_weights(path: Path) -> Path:
    """Write random weights of the smallest Depth Anything 3 in the published file format."""
    with torch.random.fork_rng():
        torch.manual_seed(_SEED)
        network = network_of("da3-small")
        fov = network.cam_dec.fc_fov[0]
        torch.nn.init.constant_(fov.bias, _ANGLE)
        torch.nn.init.zeros_(fov.weight)
    save_model(as_published(network), str(path))
    return path
