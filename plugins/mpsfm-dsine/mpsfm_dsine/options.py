"""Options of the DSINE provider, importable without onnxruntime."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options


class DsineOptions(Options):
    """Options of the DSINE provider."""

    model: str = "export:dsine"
    """Path or URI of the ONNX file. The default is the output of ``mpsfm models export dsine``."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""
    size: int = Field(1200, ge=32, le=2000)
    """Longer side of the network input in pixels. Smaller images are not enlarged. DSINE supports
    input sides of up to 2000 pixels. [reference]
    """
