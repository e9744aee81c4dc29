"""Options and default weights of the retrieval providers, importable without onnxruntime."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

DINOV2 = WeightsFile(
    "hf://Xenova/dinov2-small@bd222e886723524568931e43031f6d9327896fac/onnx/model.onnx",
    license="Apache-2.0",
)


class NetworkOptions(Options):
    """Options of a retrieval network in an ONNX file."""

    model: str = DINOV2.uri
    """Path or URI of the ONNX file. The default file is DINOv2 and needs ``network: dinov2``."""
    network: Literal["dinov2", "eigenplaces", "netvlad"] = "dinov2"
    """Name of the preprocessing that the network requires (see the README)."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""


class AppearanceOptions(Options):
    """Options of the global descriptor from SIFT features and colors.

    All defaults were tuned on two scenes (see the README).
    """

    max_keypoints: int = Field(2000, gt=0)
    """Maximum number of SIFT keypoints, selected by scale."""
    resize: int = Field(640, ge=32)
    """Longer side of the resized image in pixels for SIFT. Images are never enlarged."""
    dimensions: int = Field(4096, ge=16)
    """Number of random Fourier features, which represent the SIFT features in the descriptor."""
    sharpness: float = Field(15.0, gt=0)
    """Parameter of the kernel ``exp(-sharpness |x - y|^2)`` of two unit SIFT descriptors x, y."""
    color_share: float = Field(0.3, ge=0, lt=1)
    """Weight of the color histogram in the similarity of two images. The weight of the SIFT
    features is one minus the weight of the color histogram."""
