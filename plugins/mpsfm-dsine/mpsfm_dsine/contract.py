"""How the contract kit tests the provider without weights."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_core.testing import Setup
from mpsfm_dsine.options import DsineOptions
from mpsfm_dsine.provider import describe


def setup(folder: Path) -> Setup:
    """A network that reads painted views and is told the camera."""
    model = stand_in(describe(DsineOptions(model="")), folder)
    return Setup(options={"model": str(model)}, knows="painted")
