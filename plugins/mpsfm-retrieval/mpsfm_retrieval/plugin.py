"""Registration of the retrieval providers, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import weights_from_option
from mpsfm_retrieval.options import DINOV2, AppearanceOptions, NetworkOptions


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register a retrieval network, and a descriptor from SIFT features and colors."""
    return [
        ProviderSpec(
            kind="retrieval",
            name="global-onnx",
            factory="mpsfm_retrieval.network:GlobalNetwork",
            options=NetworkOptions,
            summary="global descriptor of a network: DINOv2, EigenPlaces, NetVLAD",
            requires=("onnxruntime",),
            install_hint="pip install mpsfm-retrieval",
            code_license="Apache-2.0",
            weights_license=f"{DINOV2.license} (DINOv2), else of the chosen model",
            weights=weights_from_option("model", DINOV2),
            contract="mpsfm_retrieval.contract:network",
        ),
        ProviderSpec(
            kind="retrieval",
            name="appearance",
            factory="mpsfm_retrieval.appearance:Appearance",
            options=AppearanceOptions,
            summary="SIFT features and colors of the image; no weights",
            code_license="Apache-2.0",
        ),
    ]
