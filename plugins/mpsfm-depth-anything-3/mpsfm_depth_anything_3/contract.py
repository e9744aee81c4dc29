"""How the contract kit tests the provider without published weights: on the real architecture of
the smallest size with random ones, which are written once for a process."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_model

from mpsfm_core.testing import ContractSetup
from mpsfm_depth_anything_3.provider import as_published, network_of

SIDE = 56
"""Of the views that the network sees, in pixels."""
_SEED = 3
_ANGLE = 1.0
"""Of view, in radians: random ones have no tangent."""


def contract(folder: Path) -> ContractSetup:
    """It answers, and means nothing."""
    path = write_weights(folder / "model.safetensors")
    return ContractSetup(options={"weights": str(path), "resize": SIDE}, truth_source="none")


def write_weights(path: Path) -> Path:
    """Random weights of the smallest network, in a file as the authors publish it."""
    with torch.random.fork_rng():
        torch.manual_seed(_SEED)
        network = network_of("da3-small")
        fov = network.cam_dec.fc_fov[0]
        torch.nn.init.constant_(fov.bias, _ANGLE)
        torch.nn.init.zeros_(fov.weight)
    save_model(as_published(network), str(path))
    return path
