"""What a user can set."""

from __future__ import annotations

from mpsfm_core import Options

MOGE_2 = "moge-2"
"""Its description."""


class OnnxOptions(Options):
    """The network and its description."""

    description: str = "fastdepth"
    """Name of a shipped description, or a YAML file."""
    model: str | None = None
    """Path or URI of the ONNX file; None takes the description's."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class Moge2Options(Options):
    """Where MoGe-2 comes from."""

    weights: str | None = None
    """Path or URI of the ONNX file; None takes the authors' small one."""
    sha256: str | None = None
    """Expected hash of ``weights``."""
