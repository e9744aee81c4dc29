"""Announces the providers. Does not import onnxruntime."""

from __future__ import annotations

from pydantic import BaseModel

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.calibration.model import DepthCalibration, NormalCalibration
from mpsfm_onnx.description import load_description
from mpsfm_onnx.options import OnnxOptions

_REQUIRES = ("onnxruntime",)
_HINT = "pip install mpsfm-onnx"
_WEIGHTS_LICENSE = "of the chosen model"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Depth, depth with normals in the same pass, and normals."""
    return [
        ProviderSpec(
            kind="depth",
            name="onnx",
            factory="mpsfm_onnx.providers:OnnxDepth",
            contract="mpsfm_onnx.contract:depth",
            options=OnnxOptions,
            capabilities=frozenset({"intrinsics-aware"}),
            summary="any depth network in an ONNX file, described in YAML",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=_WEIGHTS_LICENSE,
        ),
        ProviderSpec(
            kind="depth",
            name="onnx-joint",
            factory="mpsfm_onnx.providers:OnnxJoint",
            contract="mpsfm_onnx.contract:joint",
            options=OnnxOptions,
            capabilities=frozenset({"joint-normals", "intrinsics-aware"}),
            summary="any network in an ONNX file that predicts depth and normals together",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=_WEIGHTS_LICENSE,
        ),
        ProviderSpec(
            kind="normals",
            name="onnx",
            factory="mpsfm_onnx.providers:OnnxNormals",
            contract="mpsfm_onnx.contract:normals",
            options=OnnxOptions,
            capabilities=frozenset({"intrinsics-aware"}),
            summary="any normal network in an ONNX file, described in YAML",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=_WEIGHTS_LICENSE,
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
