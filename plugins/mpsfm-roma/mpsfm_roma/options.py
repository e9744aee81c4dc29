"""What a user can set; "reference" is the published system's value. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class RomaOptions(Options):
    """The network."""

    model: str
    """Path or URI of the ONNX file (the README says how it is made)."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    height: int = Field(672, ge=14, multiple_of=14)
    """Rows of the network's input; views are stretched to it (reference: coarse resolution)."""
    width: int = Field(672, ge=14, multiple_of=14)
    """Columns of the network's input."""
    inputs: tuple[str, str] = ("im_A", "im_B")
    """Names of the images' tensors."""
    outputs: tuple[str, str] = ("warp", "certainty")
    """Names of the tensors of the warp and of its certainty."""


class DenseSearch(Options):
    """Matches of free positions."""

    cell: int = Field(4, ge=1)
    """Of each square of so many warp pixels only the most certain match is given: the core keeps
    one in a radius of 8 pixels of the view anyway, and matches are stored."""
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Less certain matches are not given (RoMa's own threshold)."""


class SparseSearch(Options):
    """Matches of given keypoints."""

    snap_px: float = Field(2.0, gt=0)
    """Farthest that a keypoint may be from where the warp sends another one (reference)."""
    min_certainty: float = Field(0.05, ge=0, lt=1)
    """Smallest certainty of the warp at a keypoint (RoMa's own threshold)."""


class DenseOptions(RomaOptions, DenseSearch):
    """Of ``roma``."""


class SparseOptions(RomaOptions, SparseSearch):
    """Of ``roma-sparse``."""
