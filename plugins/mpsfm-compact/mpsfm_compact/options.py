"""What a user can set. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options

WEIGHTS = "package:mpsfm_compact/compact.onnx"


class CompactOptions(Options):
    """The network."""

    weights: str = WEIGHTS
    """Path or URI of the ONNX file; the default lies in this package."""
    sha256: str | None = None
    """Expected hash of ``weights``."""
    size: int = Field(256, ge=32, multiple_of=32)
    """Longer side of the network's input in pixels. It was trained at 256."""
