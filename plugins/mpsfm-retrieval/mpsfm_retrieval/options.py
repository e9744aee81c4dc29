"""Options and default weights; imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

DINOV2 = WeightsFile(
    "hf://Xenova/dinov2-small@bd222e886723524568931e43031f6d9327896fac/onnx/model.onnx",
    license="Apache-2.0",
)


class NetworkOptions(Options):
    """Options of a network in an ONNX file."""

    model: str = DINOV2.uri
    """Path or URI; the default file is for ``dinov2``."""
    network: Literal["dinov2", "eigenplaces", "netvlad"] = "dinov2"
    """Preprocessing of the image, see the README."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class AppearanceOptions(Options):
    """Options of the descriptor without weights.

    All defaults are tuned on two scenes, see the README. [ours]
    """

    max_keypoints: int = Field(2000, gt=0)
    """Number of SIFT features; the largest are kept."""
    resize: int = Field(640, ge=32)
    """Longer side for detection in pixels, never enlarged."""
    dimensions: int = Field(4096, ge=16)
    """Number of random Fourier features."""
    sharpness: float = Field(15.0, gt=0)
    """Parameter of the kernel ``exp(-sharpness |x - y|^2)`` of two unit descriptors."""
    color_share: float = Field(0.3, ge=0, lt=1)
    """Weight of the color histogram; the local descriptors have the rest."""
