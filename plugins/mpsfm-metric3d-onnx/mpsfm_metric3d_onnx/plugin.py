"""Registration of the Metric3D providers, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from pydantic import BaseModel

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import Kind, ModelExport
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_metric3d_onnx.options import SIZES, WEIGHTS_LICENSE, Metric3dOptions, Size

_NORMALS = NormalCalibration(std_scale=1.0, std_floor_deg=1.0)


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register each Metric3D size as a provider of depth with normals, and of normals."""
    return [_spec(kind, size) for kind in ("depth", "normals") for size in SIZES]


@hookimpl
def mpsfm_exports() -> dict[str, ModelExport]:
    """Register the ONNX export of Metric3D, with confidence, by its authors' code."""
    return {
        "metric3d": ModelExport(
            script="mpsfm_metric3d_onnx.export",
            repository="YvanYin/Metric3D",
            commit="eb5b6fac0dc155e4e52f576e304fbf11655ff339",
            license="none named by the authors (code BSD-2-Clause)",
            packages=("mmengine",),
        )
    }


@hookimpl
def mpsfm_calibration(
    kind: str, provider: str, options: BaseModel | None
) -> DepthCalibration | NormalCalibration | None:
    """Return the calibration of the depth variance, which depends on the option ``confidence``."""
    if kind == "depth" and isinstance(options, Metric3dOptions):
        for size in SIZES:
            if provider == _name(size) and not options.confidence:
                return size.calibration_alone
    return None


def _name(size: Size) -> str:
    return f"metric3d-v2-{size.name}"


def _spec(kind: Kind, size: Size) -> ProviderSpec:
    is_depth = kind == "depth"
    return ProviderSpec(
        kind=kind,
        name=_name(size),
        factory=f"mpsfm_metric3d_onnx.provider:Metric3d{'Depth' if is_depth else 'Normals'}",
        options=size.options,
        capabilities=frozenset(
            {"metric", "joint-normals", "intrinsics-aware"}
            if is_depth
            else {"variance", "intrinsics-aware"}
        ),
        summary=f"Metric3D v2 {size.name}: metric depth and normals",
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-metric3d-onnx",
        code_license="Apache-2.0",
        weights_license=WEIGHTS_LICENSE,
        weights=size.files,
        accuracy="not measured by us; std of depth declared as 8 %",
        calibration=size.calibration if is_depth else _NORMALS,
        contract="mpsfm_metric3d_onnx.contract:setup",
    )
