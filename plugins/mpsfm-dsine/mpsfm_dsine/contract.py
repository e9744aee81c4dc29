"""How the contract kit tests the provider without weights."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_core.testing import ContractSetup
from mpsfm_dsine.options import DsineOptions
from mpsfm_dsine.provider import describe


def setup(folder: Path) -> ContractSetup:
    """A network that reads painted views and is told the camera."""
    model = stand_in(describe(DsineOptions(model="")), folder)
    return ContractSetup(options={"model": str(model)}, truth_source="painted")
