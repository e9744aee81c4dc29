"""Small ONNX network that averages colors, for the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.stand_in import save_model

from mpsfm_core.testing import ContractSetup

_COARSE = """
coarse (float[b,3,h,w] image) => (float[b,d] descriptor) {
    small = AveragePool <kernel_shape = [64, 64], strides = [64, 64]> (image)
    descriptor = Flatten (small)
}
"""


def network(folder: Path) -> ContractSetup:
    """Write a network that averages colors, with a fixed input size like EigenPlaces."""
    model = save_model(_COARSE, folder / "coarse.onnx")
    return ContractSetup(
        options={"model": str(model), "network": "eigenplaces"}, truth_source="image"
    )
