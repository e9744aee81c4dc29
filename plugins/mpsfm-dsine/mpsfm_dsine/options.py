"""Options of the provider; imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class DsineOptions(Options):
    """Options of the network."""

    model: str = "export:dsine"
    """Path or URI of the ONNX file; default: the output of ``mpsfm models export dsine``."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    size: int = Field(1200, ge=32, le=2000)
    """Longer side of the network input in pixels; views are never enlarged. The network supports up
    to 2000 pixels. [reference]
    """
