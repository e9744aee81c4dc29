"""Registration of the DSINE provider, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.providers import ModelExport, weights_from_option
from mpsfm_core.providers.uncertainty.calibration import NormalCalibration
from mpsfm_dsine.options import DsineOptions


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register DSINE as a provider of normals."""
    return [
        ProviderSpec(
            kind="normals",
            name="dsine",
            factory="mpsfm_dsine.provider:Dsine",
            options=DsineOptions,
            capabilities=frozenset({"variance", "intrinsics-aware"}),
            summary="DSINE: normals with their angular variance, for known intrinsics",
            requires=("onnxruntime",),
            install_hint="pip install mpsfm-dsine",
            code_license="Apache-2.0",
            weights_license="of the authors' checkpoint (code MIT)",
            weights=weights_from_option(
                "model", WeightsFile("export:dsine", license="of the authors")
            ),
            calibration=NormalCalibration(std_scale=1.0, std_floor_deg=1.0),
            contract="mpsfm_dsine.contract:setup",
        )
    ]


@hookimpl
def mpsfm_exports() -> dict[str, ModelExport]:
    """Register the ONNX export that runs the authors' code and checkpoint."""
    return {
        "dsine": ModelExport(
            script="mpsfm_dsine.export",
            repository="baegwangbin/DSINE",
            commit="ef0c2afa32b4dd19cb8ca4567c652802cd92591c",
            license="of the authors' checkpoint (code MIT)",
            packages=("geffnet",),
        )
    }
