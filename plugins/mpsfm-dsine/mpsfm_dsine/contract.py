"""Small ONNX network that replaces DSINE in the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_core.testing import ContractSetup
from mpsfm_dsine.options import DsineOptions
from mpsfm_dsine.provider import describe


def setup(folder: Path) -> ContractSetup:
    """Write a network with DSINE's tensors that decodes normals from the colors of test images."""
    model = stand_in(describe(DsineOptions(model="")), folder)
    return ContractSetup(options={"model": str(model)}, truth_source="painted")
