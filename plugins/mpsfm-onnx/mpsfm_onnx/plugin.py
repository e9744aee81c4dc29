"""Announces the providers. Does not import onnxruntime."""

from __future__ import annotations

from pydantic import BaseModel

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import Capability, Kind
from mpsfm_core.uncertainty.model import DepthCalibration, NormalCalibration
from mpsfm_onnx.description import load_description
from mpsfm_onnx.options import OnnxOptions


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Depth, normals, and networks with both, chosen by one name for either kind."""
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
    ]


@hookimpl
def mpsfm_calibration(
    kind: str, provider: str, options: BaseModel | None
) -> DepthCalibration | NormalCalibration | None:
    """The uncertainty that the chosen description declares."""
    if not (provider in ("onnx", "onnx-joint") and isinstance(options, OnnxOptions)):
        return None
    description = load_description(options.description)
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
    )
