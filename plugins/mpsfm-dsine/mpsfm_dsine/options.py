"""What a user can set. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class DsineOptions(Options):
    """The network."""

    model: str = "export:dsine"
    """Path or URI of the ONNX file; by default what ``mpsfm models export dsine`` made."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    size: int = Field(1200, ge=32, le=2000)
    """Longer side in pixels at which the network sees a view, never enlarged (reference: the size
    of its images); the network knows rays up to 2000 pixels."""
