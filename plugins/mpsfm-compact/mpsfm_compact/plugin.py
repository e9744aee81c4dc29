"""Registration of the compact network's providers, without heavy imports."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from mpsfm_compact.options import CAMERA_WEIGHTS, WEIGHTS, CameraOptions, CompactOptions
from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.providers import Capability, Kind, weights_from_option
from mpsfm_core.providers.uncertainty.calibration import Calibration
from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind, load_calibration

_LICENSE = "Apache-2.0"
_ACCURACY: dict[Kind, str] = {
    "depth": "AbsRel 0.15 in a real room, 0.10 on a facade, after each photo's scale (measured)",
    "normals": "median 6 deg in a rendered kitchen (measured)",
    "mask": "detects sky well, mirrors and glass rarely",
    "camera": "median error of the focal length 12 % on a facade, 13 % in a room (measured)",
}
"""Measured in benchmarks/results/priors.md; the camera is measured in the README of the plugin."""


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register the compact network as a provider of depth, normals, masks and cameras."""
    return [
        _spec("depth", "Depth", "metric depth and normals", "metric", "variance", "joint-normals"),
        _spec("normals", "Normals", "normals", "variance"),
        _spec("mask", "Mask", "leaves out sky, mirrors and glass"),
        _camera_spec(),
    ]


def _camera_spec() -> ProviderSpec:
    return ProviderSpec(
        kind="camera",
        name="compact",
        factory="mpsfm_compact.provider:CompactCamera",
        options=CameraOptions,
        capabilities=frozenset({"estimates-radial", "estimates-gravity"}),
        summary="small network, weights included: focal length, distortion and gravity",
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-compact",
        code_license=_LICENSE,
        weights_license=_LICENSE,
        weights=weights_from_option("weights", WeightsFile(CAMERA_WEIGHTS, license=_LICENSE)),
        accuracy=_ACCURACY["camera"],
        contract="mpsfm_compact.contract:camera",
    )


def _spec(
    kind: Literal["depth", "normals", "mask"], factory: str, summary: str, *capabilities: Capability
) -> ProviderSpec:
    return ProviderSpec(
        kind=kind,
        name="compact",
        factory=f"mpsfm_compact.provider:Compact{factory}",
        options=CompactOptions,
        capabilities=frozenset({"intrinsics-aware", *capabilities}),
        summary=f"small network, weights included: {summary}",
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-compact",
        code_license=_LICENSE,
        weights_license=_LICENSE,
        weights=weights_from_option("weights", WeightsFile(WEIGHTS, license=_LICENSE)),
        accuracy=_ACCURACY[kind],
        calibration=None if kind == "mask" else _calibration(kind),
        contract="mpsfm_compact.contract:setup",
    )


def _calibration(kind: CalibratedKind) -> Calibration:
    return load_calibration(Path(__file__).with_name(f"calibration-{kind}.yaml"), kind)
