"""Options of the MASt3R matchers, importable without onnxruntime."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class FileOptions(Options):
    """Options that select the ONNX file of MASt3R."""

    model: str = "export:mast3r"
    """Path or URI of the ONNX file. The default is the output of ``mpsfm models export mast3r``."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""


class SizeOptions(Options):
    """Option for the size of MASt3R's input images."""

    size: int = Field(512, ge=16)
    """Longer side of the network input in pixels. Smaller images are enlarged. [reference]"""


class DenseSearch(SizeOptions):
    """Options of MASt3R's dense matching."""

    subsample: int = Field(8, ge=1)
    """Step in pixels of the network input between the pixels from which the reciprocal search
    starts. A search from fewer start pixels is faster and finds fewer matches. [reference]"""


class SparseSearch(SizeOptions):
    """Options of MASt3R's matching at given keypoints."""

    min_similarity: float = Field(0.85, ge=-1, le=1)
    """Minimum cosine similarity of the descriptors of a match. [reference]"""


class Mast3rOptions(FileOptions, SizeOptions):
    """Options of the dense and the sparse MASt3R matcher."""


class DenseOptions(Mast3rOptions, DenseSearch):
    """Options of the provider ``mast3r``, the dense matcher."""


class SparseOptions(Mast3rOptions, SparseSearch):
    """Options of the provider ``mast3r-sparse``, which matches given keypoints."""
