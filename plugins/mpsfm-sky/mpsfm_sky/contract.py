"""Small ONNX sky network and textured test images, for the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.stand_in import save_model

from mpsfm_core.testing import ContractSetup

_PAINTED_SKY = """
sky (float[b,3,h,w] image) => (float[b,1,h,w] d0)
<int64[1] red = {0}, float[1] steep = {-255}, float[1] one = {1}, float[1] zero = {0}> {
    depth = Gather <axis = 1> (image, red)
    away = Mul (depth, steep)
    above = Add (away, one)
    d0 = Max (above, zero)
}
"""
"""Network that returns 1 where the red channel of a test image, which encodes depth, is 0."""


def network(folder: Path) -> ContractSetup:
    """Write a sky network that masks the pixels of test images that have no depth."""
    path = save_model(_PAINTED_SKY, folder / "sky.onnx")
    return ContractSetup(
        options={"model": str(path), "network": "skysegsmall"}, truth_source="painted"
    )


def simple(folder: Path) -> ContractSetup:
    """Test the rule-based mask on the blue sky of the textured test images."""
    return ContractSetup(truth_source="image")
