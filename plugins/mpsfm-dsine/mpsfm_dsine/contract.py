"""Contract setup: a stand-in network without weights."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_core.testing import ContractSetup
from mpsfm_dsine.options import DsineOptions
from mpsfm_dsine.provider import describe


def setup(folder: Path) -> ContractSetup:
    """Write a network with an intrinsics input that decodes painted views."""
    model = stand_in(describe(DsineOptions(model="")), folder)
    return ContractSetup(options={"model": str(model)}, truth_source="painted")
