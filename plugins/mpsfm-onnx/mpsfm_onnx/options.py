"""Options of the providers."""

from __future__ import annotations

from mpsfm_core import Options

MOGE_2 = "moge-2"
"""Name of the description of MoGe-2."""


class OnnxOptions(Options):
    """Options of a described network."""

    description: str = "fastdepth"
    """Name of a shipped description, or a YAML file."""
    model: str | None = None
    """Path or URI of the ONNX file; null: file of the description."""
    sha256: str | None = None
    """Expected hash of ``model``."""


class Moge2Options(Options):
    """Options of MoGe-2."""

    weights: str | None = None
    """Path or URI of the ONNX file; null: the authors' small one."""
    sha256: str | None = None
    """Expected hash of ``weights``."""
