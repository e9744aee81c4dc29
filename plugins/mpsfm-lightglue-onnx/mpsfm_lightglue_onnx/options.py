"""Options and default weights of the ONNX networks, importable without onnxruntime."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options, WeightsFile

_RELEASE = "https://github.com/fabio-sim/LightGlue-ONNX/releases/download/v0.1.0"
_NON_COMMERCIAL = "Magic Leap: non-commercial research only"

SUPERPOINT = WeightsFile(f"{_RELEASE}/superpoint.onnx", license=_NON_COMMERCIAL)
DISK = WeightsFile(f"{_RELEASE}/disk.onnx", license="Apache-2.0")
LIGHTGLUE_SUPERPOINT = WeightsFile(f"{_RELEASE}/superpoint_lightglue.onnx", license="Apache-2.0")
LIGHTGLUE_DISK = WeightsFile(f"{_RELEASE}/disk_lightglue.onnx", license="Apache-2.0")


class FeatureOptions(Options):
    """Options of the detectors SuperPoint and DISK.

    The score thresholds of both detectors are part of the ONNX file.
    """

    max_keypoints: int = Field(6000, gt=0)
    """Maximum number of keypoints, selected by score. [reference, for SuperPoint]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side of the resized image in pixels for detection. Images are never enlarged, and null
    keeps their size. [reference]
    """
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""


class SuperPointOptions(FeatureOptions):
    """Options of the SuperPoint detector (2018), which has 256-dimensional descriptors."""

    model: str = SUPERPOINT.uri
    """Path or URI of the SuperPoint ONNX file."""


class DiskOptions(FeatureOptions):
    """Options of the DISK detector (NeurIPS 2020), which has 128-dimensional descriptors."""

    max_keypoints: int = Field(2048, gt=0)
    """Maximum number of keypoints, selected by score. [LightGlue: as in training]"""
    model: str = DISK.uri
    """Path or URI of the DISK ONNX file."""


class LightGlueOptions(Options):
    """Options of LightGlue for one type of features."""

    min_score: float = Field(0.1, ge=0, lt=1)
    """Minimum score of a match, in addition to the threshold inside the ONNX file. [LightGlue
    filter_threshold]
    """
    model: str = LIGHTGLUE_SUPERPOINT.uri
    """Path or URI of the LightGlue ONNX file."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""


class DiskLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DISK features."""

    model: str = LIGHTGLUE_DISK.uri
