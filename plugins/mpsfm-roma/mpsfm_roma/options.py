"""Options of the matchers; imports nothing heavy. "reference" is the authors' implementation."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class RomaOptions(Options):
    """Options of the network."""

    model: str
    """Path or URI of the ONNX file, see the README."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    height: int = Field(672, ge=14, multiple_of=14)
    """Rows of the network input; views are stretched. [reference: coarse resolution]"""
    width: int = Field(672, ge=14, multiple_of=14)
    """Columns of the network input."""
    inputs: tuple[str, str] = ("im_A", "im_B")
    """Names of the image tensors."""
    outputs: tuple[str, str] = ("warp", "certainty")
    """Names of the tensors of warp and certainty."""


class DenseSearch(Options):
    """Options of dense matching."""

    cell: int = Field(4, ge=1)
    """Side in warp pixels of the cells with one match each. The core keeps one match within 8
    pixels of the view, so a smaller value only stores more.
    """
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Minimum certainty of a match. [RoMa]"""


class SparseSearch(Options):
    """Options of matching at keypoints."""

    snap_px: float = Field(2.0, gt=0)
    """Maximum distance in pixels between a keypoint and a warped keypoint. [reference]"""
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Minimum certainty of the warp at a keypoint. [RoMa]"""


class DenseOptions(RomaOptions, DenseSearch):
    """Options of ``roma``."""


class SparseOptions(RomaOptions, SparseSearch):
    """Options of ``roma-sparse``."""
