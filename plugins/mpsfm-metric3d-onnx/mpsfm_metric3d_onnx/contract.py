"""Small ONNX network that replaces Metric3D in the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_core.testing import ContractSetup
from mpsfm_metric3d_onnx.options import Metric3dOptions
from mpsfm_metric3d_onnx.provider import describe


def setup(folder: Path) -> ContractSetup:
    """Write a network with Metric3D's tensors that decodes depth and normals from image colors."""
    model = stand_in(describe(Metric3dOptions(weights="", confidence=True)), folder)
    return ContractSetup(
        options={"weights": str(model), "confidence": True}, truth_source="painted"
    )
