"""Options and default weights; imports nothing heavy."""

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
    """Options of both detectors; thresholds are part of the exported model."""

    max_keypoints: int = Field(6000, gt=0)
    """Number of keypoints with the highest score to keep. [reference, for SuperPoint]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side for detection in pixels, never enlarged; null: the size of the view. [reference]
    """
    sha256: str | None = None
    """Expected hash of ``model``."""


class SuperPointOptions(FeatureOptions):
    """Options of SuperPoint (2018), 256 dimensions."""

    model: str = SUPERPOINT.uri
    """Path or URI of the ONNX file."""


class DiskOptions(FeatureOptions):
    """Options of DISK (NeurIPS 2020), 128 dimensions."""

    max_keypoints: int = Field(2048, gt=0)
    """Number of keypoints with the highest score to keep. [LightGlue: as in training]"""
    model: str = DISK.uri
    """Path or URI of the ONNX file."""


class LightGlueOptions(Options):
    """Options of LightGlue for one feature family."""

    min_score: float = Field(0.1, ge=0, lt=1)
    """Minimum score of a match, in addition to the threshold of the exported model. [LightGlue
    filter_threshold]
    """
    model: str = LIGHTGLUE_SUPERPOINT.uri
    """Path or URI of the ONNX file."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class DiskLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DISK."""

    model: str = LIGHTGLUE_DISK.uri
