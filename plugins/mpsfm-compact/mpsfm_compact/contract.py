"""Small ONNX network that replaces the trained one in the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_compact.options import CompactOptions
from mpsfm_compact.provider import describe
from mpsfm_core.testing import ContractSetup


def setup(folder: Path) -> ContractSetup:
    """Write a test network with the tensors of ``compact`` that decodes depth from image colors."""
    model = stand_in(describe(CompactOptions()), folder)
    return ContractSetup(options={"weights": str(model)}, truth_source="painted")
