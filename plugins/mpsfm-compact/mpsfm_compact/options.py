"""Options of the compact network, importable without onnxruntime."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core import Options

WEIGHTS = "package:mpsfm_compact/compact.onnx"
CAMERA_WEIGHTS = "package:mpsfm_compact/camera.onnx"


class CompactOptions(Options):
    """Options of the compact network."""

    weights: str = WEIGHTS
    """Path or URI of the ONNX file; the default file is part of this package."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``."""
    size: int = Field(256, ge=32, multiple_of=32)
    """Longer side of the network input in pixels. The compact network is trained on images of about
    256 x 192 pixels. Larger network inputs resolve thinner structures, but the depth is less
    accurate on average.
    """


class CameraOptions(Options):
    """Options of the compact camera network."""

    weights: str = CAMERA_WEIGHTS
    """Path or URI of the ONNX file; the default file is part of this package."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``."""
