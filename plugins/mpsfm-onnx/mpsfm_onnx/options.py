"""What a user can set."""

from __future__ import annotations

from mpsfm_core import Options


class OnnxOptions(Options):
    """The network and its description."""

    description: str = "fastdepth"
    """Name of a shipped description, or a YAML file."""
    model: str | None = None
    """Path or URI of the ONNX file; None takes the description's."""
    sha256: str | None = None
    """Expected hash of ``model``."""
