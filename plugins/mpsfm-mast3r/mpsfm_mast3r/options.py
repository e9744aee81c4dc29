"""What a user can set; "reference" is the published system's value. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class Mast3rOptions(Options):
    """The network."""

    model: str = "export:mast3r"
    """Path or URI of the ONNX file; by default what ``mpsfm models export mast3r`` made."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    size: int = Field(512, ge=16)
    """Longer side of the views as the network sees them, enlarged if need be (reference)."""


class DenseOptions(Mast3rOptions):
    """Matches of free positions."""

    subsample: int = Field(8, ge=1)
    """The search for reciprocal neighbours starts at every so many pixels (reference)."""


class SparseOptions(Mast3rOptions):
    """Matches of given keypoints."""

    min_similarity: float = Field(0.85, ge=-1, le=1)
    """Smallest cosine of the descriptors of a match (reference)."""
