"""What a user can set, and the default weights. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

DINOV2 = WeightsFile(
    "hf://Xenova/dinov2-small@bd222e886723524568931e43031f6d9327896fac/onnx/model.onnx",
    license="Apache-2.0",
)


class NetworkOptions(Options):
    """A network in an ONNX file that describes a whole image."""

    model: str = DINOV2.uri
    """Path or URI; the default is for ``dinov2``, other networks need their own file."""
    network: Literal["dinov2", "eigenplaces", "netvlad"] = "dinov2"
    """How it wants the image, see the README."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class AppearanceOptions(Options):
    """Local features and colours without weights (all defaults ours: the best of those tried for
    recall on a HoloLens room and a rendered kitchen, see the README)."""

    max_keypoints: int = Field(2000, gt=0)
    """SIFT features; the largest are kept."""
    resize: int = Field(640, ge=32)
    """Longer side in pixels at which they are detected, never enlarged."""
    dimensions: int = Field(4096, ge=16)
    """Random features of the mean of the local descriptors."""
    sharpness: float = Field(15.0, gt=0)
    """Two unit descriptors x, y count as ``exp(-sharpness |x - y|^2)`` the same."""
    colour_share: float = Field(0.3, ge=0, lt=1)
    """Weight of the colours; the rest is the local descriptors'."""
