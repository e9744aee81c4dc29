"""What a user can set; "reference" is the published system's value. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class FileOptions(Options):
    """The network's file."""

    model: str = "export:mast3r"
    """Path or URI of the ONNX file; by default what ``mpsfm models export mast3r`` made."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class SizeOptions(Options):
    """What the network sees."""

    size: int = Field(512, ge=16)
    """Longer side of the views as the network sees them, enlarged if need be (reference)."""


class DenseSearch(SizeOptions):
    """Matches of free positions."""

    subsample: int = Field(8, ge=1)
    """The search for reciprocal neighbours starts at every so many pixels (reference)."""


class SparseSearch(SizeOptions):
    """Matches of given keypoints."""

    min_similarity: float = Field(0.85, ge=-1, le=1)
    """Smallest cosine of the descriptors of a match (reference)."""


class Mast3rOptions(FileOptions, SizeOptions):
    """Of either matcher."""


class DenseOptions(Mast3rOptions, DenseSearch):
    """Of ``mast3r``."""


class SparseOptions(Mast3rOptions, SparseSearch):
    """Of ``mast3r-sparse``."""
