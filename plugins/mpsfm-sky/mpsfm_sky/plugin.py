"""Registration of the sky mask providers, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import weights_from_option
from mpsfm_sky.options import SKYSEG, SimpleSkyOptions, SkyOptions


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register a sky segmentation network and a rule-based sky mask."""
    return [
        ProviderSpec(
            kind="mask",
            name="sky",
            factory="mpsfm_sky.network:SkyNetwork",
            options=SkyOptions,
            summary="masks the sky with a segmentation network",
            requires=("onnxruntime",),
            install_hint="pip install mpsfm-sky",
            code_license="Apache-2.0",
            weights_license="of the chosen model (skyseg: MIT)",
            weights=weights_from_option("model", SKYSEG),
            contract="mpsfm_sky.contract:network",
        ),
        ProviderSpec(
            kind="mask",
            name="sky-simple",
            factory="mpsfm_sky.simple:SimpleSky",
            options=SimpleSkyOptions,
            summary="masks smooth bright or blue regions at the upper border; outdoors only",
            code_license="Apache-2.0",
            contract="mpsfm_sky.contract:simple",
        ),
    ]
