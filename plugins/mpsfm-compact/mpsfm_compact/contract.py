"""How the contract kit tests the providers: a stand-in that reads painted views in place of the
network."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_compact.options import CompactOptions
from mpsfm_compact.provider import describe
from mpsfm_core.testing import Setup


def setup(folder: Path) -> Setup:
    """A network with the same tensors that reads painted views."""
    model = stand_in(describe(CompactOptions()), folder)
    return Setup(options={"weights": str(model)}, knows="painted")
