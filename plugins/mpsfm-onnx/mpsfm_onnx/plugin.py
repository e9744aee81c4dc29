"""Registration of the ONNX providers, without importing onnxruntime."""

from __future__ import annotations

from pydantic import BaseModel

from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.providers import Capability, Kind, ModelExport
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_onnx.description import load_description
from mpsfm_onnx.options import MOGE_2, Moge2Options, OnnxOptions

_MOGE_ACCURACY = "not measured by us; std of depth declared as 8 %"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register ONNX providers of depth, of normals, and of both from one network."""
    return [
        _spec(
            "depth",
            "onnx",
            "Depth",
            "any depth network in an ONNX file, described in YAML",
            "estimates-focal",
        ),
        _spec(
            "depth",
            "onnx-joint",
            "Joint",
            "any network in an ONNX file that predicts depth and normals together",
            "estimates-focal",
            "joint-normals",
        ),
        _spec("normals", "onnx", "Normals", "any normals network in an ONNX file"),
        _spec(
            "normals",
            "onnx-joint",
            "Normals",
            "normals of such a network, in the same pass as depth of the same options",
        ),
        _moge("depth", "Moge2", "metric", "joint-normals"),
        _moge("normals", "Moge2Normals"),
    ]


@hookimpl
def mpsfm_exports() -> dict[str, ModelExport]:
    """Register the ONNX exports of MoGe-2 and UniDepth V2 by their authors' code."""
    return {
        "moge": ModelExport(
            script="mpsfm_onnx.export_moge",
            repository="microsoft/MoGe",
            commit="07444410f1e33f402353b99d6ccd26bd31e469e8",
            license="MIT",
            packages=("github.com/EasternJournalist/utils3d", "moderngl"),
        ),
        "unidepth": ModelExport(
            script="mpsfm_onnx.export_unidepth",
            repository="lpiccinelli-eth/UniDepth",
            commit="8d8cfe4c7ee15297099983607febf0d4f32eb3d6",
            license="CC-BY-NC-4.0",
            packages=("einops", "huggingface_hub", "scipy"),
        ),
    }


@hookimpl
def mpsfm_calibration(
    kind: str, provider: str, options: BaseModel | None
) -> DepthCalibration | NormalCalibration | None:
    """Return the variance calibration in the network description that the options select."""
    if isinstance(options, Moge2Options):
        description = load_description(MOGE_2)
    elif provider in ("onnx", "onnx-joint") and isinstance(options, OnnxOptions):
        description = load_description(options.description)
    else:
        return None
    return description.calibration if kind == "depth" else description.normals_calibration


def _spec(
    kind: Kind, name: str, factory: str, summary: str, *capabilities: Capability
) -> ProviderSpec:
    return ProviderSpec(
        kind=kind,
        name=name,
        factory=f"mpsfm_onnx.providers:Onnx{factory}",
        contract="mpsfm_onnx.contract:setup",
        options=OnnxOptions,
        capabilities=frozenset({"intrinsics-aware", *capabilities}),
        summary=summary,
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-onnx",
        code_license="Apache-2.0",
        weights_license="of the chosen model",
        weights=_onnx_files,
        accuracy="of the chosen network",
    )


def _moge(kind: Kind, factory: str, *capabilities: Capability) -> ProviderSpec:
    return ProviderSpec(
        kind=kind,
        name="moge-2-small",
        factory=f"mpsfm_onnx.providers:{factory}",
        contract="mpsfm_onnx.contract:moge",
        options=Moge2Options,
        capabilities=frozenset({"intrinsics-aware", *capabilities}),
        summary="MoGe-2 ViT-S: metric depth and normals",
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-onnx",
        code_license="Apache-2.0",
        weights_license="MIT",
        weights=_moge_files,
        accuracy=_MOGE_ACCURACY,
    )


def _onnx_files(options: OnnxOptions) -> tuple[WeightsFile, ...]:
    return load_description(options.description).files(options.model, options.sha256)


def _moge_files(options: Moge2Options) -> tuple[WeightsFile, ...]:
    return load_description(MOGE_2).files(options.weights, options.sha256)
