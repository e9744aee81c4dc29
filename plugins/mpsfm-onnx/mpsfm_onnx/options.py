"""Options of the ONNX providers, importable without onnxruntime."""

from __future__ import annotations

from mpsfm_core import Options

MOGE_2 = "moge-2"
"""Name of the shipped description of MoGe-2."""


class OnnxOptions(Options):
    """Options of a provider whose network is described in YAML."""

    description: str = "fastdepth"
    """Name of a shipped network description, or path of a YAML file."""
    model: str | None = None
    """Path or URI of the ONNX file. null selects the ONNX file that the network description
    names."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""


class Moge2Options(Options):
    """Options of MoGe-2."""

    weights: str | None = None
    """Path or URI of the ONNX file. null selects the small MoGe-2 that its authors published."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``."""
