"""Registration of SuperPoint, DISK and LightGlue, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import weights_from_option
from mpsfm_lightglue_onnx import options as opt

_REQUIRES = ("onnxruntime",)
_HINT = "pip install mpsfm-lightglue-onnx"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register SuperPoint, DISK, and one LightGlue matcher for each of them."""
    return [
        ProviderSpec(
            kind="features",
            name="superpoint",
            factory="mpsfm_lightglue_onnx.features:SuperPoint",
            options=opt.SuperPointOptions,
            summary="SuperPoint: the paper's features",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=opt.SUPERPOINT.license,
            weights=weights_from_option("model", opt.SUPERPOINT),
            tags=("superpoint",),
            contract="mpsfm_lightglue_onnx.contract:superpoint",
        ),
        ProviderSpec(
            kind="features",
            name="disk-onnx",
            factory="mpsfm_lightglue_onnx.features:Disk",
            options=opt.DiskOptions,
            summary="DISK without torch",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=opt.DISK.license,
            weights=weights_from_option("model", opt.DISK),
            tags=("disk",),
            contract="mpsfm_lightglue_onnx.contract:disk",
        ),
        ProviderSpec(
            kind="matcher",
            name="lightglue-superpoint",
            factory="mpsfm_lightglue_onnx.matcher:LightGlue",
            options=opt.LightGlueOptions,
            capabilities=frozenset({"sparse"}),
            summary="LightGlue: learned matching of SuperPoint",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=opt.LIGHTGLUE_SUPERPOINT.license,
            weights=weights_from_option("model", opt.LIGHTGLUE_SUPERPOINT),
            tags=("superpoint",),
            contract="mpsfm_lightglue_onnx.contract:lightglue",
        ),
        ProviderSpec(
            kind="matcher",
            name="lightglue-disk-onnx",
            factory="mpsfm_lightglue_onnx.matcher:LightGlue",
            options=opt.DiskLightGlueOptions,
            capabilities=frozenset({"sparse"}),
            summary="LightGlue: learned matching of DISK, without torch",
            requires=_REQUIRES,
            install_hint=_HINT,
            code_license="Apache-2.0",
            weights_license=opt.LIGHTGLUE_DISK.license,
            weights=weights_from_option("model", opt.LIGHTGLUE_DISK),
            tags=("disk",),
            contract="mpsfm_lightglue_onnx.contract:lightglue",
        ),
    ]
