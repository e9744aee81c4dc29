"""Options of the matchers; imports nothing heavy. "reference" is the authors' implementation."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class FileOptions(Options):
    """File of the network."""

    model: str = "export:mast3r"
    """Path or URI of the ONNX file; default: the output of ``mpsfm models export mast3r``."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class SizeOptions(Options):
    """Size of the network input."""

    size: int = Field(512, ge=16)
    """Longer side of the network input in pixels; small views are enlarged. [reference]"""


class DenseSearch(SizeOptions):
    """Options of dense matching."""

    subsample: int = Field(8, ge=1)
    """Step in pixels of the start positions of the reciprocal search. [reference]"""


class SparseSearch(SizeOptions):
    """Options of matching at keypoints."""

    min_similarity: float = Field(0.85, ge=-1, le=1)
    """Minimum cosine of the descriptors of a match. [reference]"""


class Mast3rOptions(FileOptions, SizeOptions):
    """Options of both matchers."""


class DenseOptions(Mast3rOptions, DenseSearch):
    """Options of ``mast3r``."""


class SparseOptions(Mast3rOptions, SparseSearch):
    """Options of ``mast3r-sparse``."""
