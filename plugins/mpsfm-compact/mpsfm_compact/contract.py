"""How the contract kit tests the providers: a stand-in that reads painted views in place of the
network."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_compact.options import CompactOptions
from mpsfm_compact.provider import describe
from mpsfm_core.testing import ContractSetup


def setup(folder: Path) -> ContractSetup:
    """A network with the same tensors that reads painted views."""
    model = stand_in(describe(CompactOptions()), folder)
    return ContractSetup(options={"weights": str(model)}, truth_source="painted")
