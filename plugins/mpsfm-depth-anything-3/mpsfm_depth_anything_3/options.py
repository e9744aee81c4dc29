"""Options of Depth Anything 3 and its published weights, importable without torch."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

Network = Literal["da3-small", "da3-base", "da3-large", "da3-giant", "da3nested-giant-large"]

_NON_COMMERCIAL = "CC-BY-NC-4.0"
LICENSES: dict[str, str] = {
    "da3-small": "Apache-2.0",
    "da3-base": "Apache-2.0",
    "da3-large": _NON_COMMERCIAL,
    "da3-giant": _NON_COMMERCIAL,
    "da3nested-giant-large": _NON_COMMERCIAL,
}
"""License of the published weights of each network, from its model card."""


class DepthAnything3Options(Options):
    """Options of the Depth Anything 3 provider (2025)."""

    network: Network = "da3-small"
    """Name of the network architecture in the Depth Anything 3 package."""
    weights: str | None = None
    """Path or URI of a safetensors file. null selects the published weights of ``network``."""
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``."""
    resize: int = Field(504, ge=28)
    """Longer side of the resized images in pixels, rounded to multiples of 14."""
    relative_std: float = Field(0.2, gt=0)
    """Std of depth where the predicted confidence is 1, relative to the mean depth of an image
    group. The training loss ``confidence * error - alpha * log(confidence)`` makes the confidence
    equal to ``alpha / error``, but alpha is not published.
    """

    @property
    def file(self) -> str:
        """Return the path or URI of the weights that the options select."""
        return self.weights or f"hf://depth-anything/{self.network.upper()}@main/model.safetensors"


def weights(options: Any) -> tuple[WeightsFile, ...]:
    """Return the Depth Anything 3 weights that the options select, with hash and license."""
    license = LICENSES[options.network] if options.weights is None else "unknown"
    return (WeightsFile(options.file, options.sha256, license),)
