"""How the contract kit tests LoFTR without its weights."""

from __future__ import annotations

from pathlib import Path

import torch
from kornia.feature import LoFTR

from mpsfm_core.testing import Setup


def loftr(folder: Path) -> Setup:
    """A network of random weights, saved as the published ones are: it finds matches, and they
    mean nothing."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = LoFTR(pretrained=None).eval()
    path = folder / "loftr.ckpt"
    state = {f"matcher.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, path)
    options = {"weights": str(path), "resize": 128, "match_threshold": 0.0}
    return Setup(options=options, knows="nothing")
