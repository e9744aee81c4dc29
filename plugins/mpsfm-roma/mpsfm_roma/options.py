"""Options of the RoMa matchers, importable without onnxruntime."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class RomaOptions(Options):
    """Options of RoMa's network."""

    model: str
    """Path or URI of the ONNX file (see the README)."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""
    height: int = Field(672, ge=14, multiple_of=14)
    """Height of the network input in pixels. Images are stretched to the size of RoMa's input.
    [reference: coarse resolution]"""
    width: int = Field(672, ge=14, multiple_of=14)
    """Width of the network input in pixels."""
    inputs: tuple[str, str] = ("im_A", "im_B")
    """Names of the two image tensors in the ONNX file."""
    outputs: tuple[str, str] = ("warp", "certainty")
    """Names of the tensors of warp and certainty in the ONNX file."""


class DenseSearch(Options):
    """Options of RoMa's dense matching."""

    cell: int = Field(4, ge=1)
    """Side in warp pixels of the grid cells that yield one match each. The core merges matches
    within 8 pixels of the image, so a smaller value only stores more matches.
    """
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Minimum certainty of a match."""


class SparseSearch(Options):
    """Options of RoMa's matching at given keypoints."""

    snap_px: float = Field(2.0, gt=0)
    """Maximum distance in pixels between a keypoint and the warped position of the other
    keypoint. [reference]"""
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Minimum certainty of the warp at a keypoint."""


class DenseOptions(RomaOptions, DenseSearch):
    """Options of the provider ``roma``, the dense matcher."""


class SparseOptions(RomaOptions, SparseSearch):
    """Options of the provider ``roma-sparse``, which matches given keypoints."""
