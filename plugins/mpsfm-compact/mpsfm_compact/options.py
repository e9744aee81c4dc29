"""Options of the providers; imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options

WEIGHTS = "package:mpsfm_compact/compact.onnx"


class CompactOptions(Options):
    """Options of the network."""

    weights: str = WEIGHTS
    """Path or URI of the ONNX file; the default file is part of this package."""
    sha256: str | None = None
    """Expected hash of ``weights``."""
    size: int = Field(256, ge=32, multiple_of=32)
    """Longer side of the network input in pixels; the network is trained at 256. Larger values keep
    thinner structures and are less accurate on average.
    """
