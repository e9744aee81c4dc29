"""Options of the provider and its published weights; imports nothing heavy."""

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
"""Licenses of the published weights, from their model cards."""


class DepthAnything3Options(Options):
    """Options of Depth Anything 3 (2025)."""

    network: Network = "da3-small"
    """The authors' name of the architecture."""
    weights: str | None = None
    """Path or URI of a safetensors file; null: the published weights of the network."""
    sha256: str | None = None
    """Expected hash of ``weights``."""
    resize: int = Field(504, ge=28)
    """Longer side of the photos in pixels, rounded to multiples of 14. [authors' default]"""
    relative_std: float = Field(0.2, gt=0)
    """Std of depth for a confidence of 1, relative to the mean depth of a group. The training loss
    ``confidence * error - alpha * log(confidence)`` makes the confidence ``alpha / error``; alpha
    is not published. [alpha of DUSt3R]
    """

    @property
    def file(self) -> str:
        """Return the weights file of the options."""
        return self.weights or f"hf://depth-anything/{self.network.upper()}@main/model.safetensors"


def weights(options: Any) -> tuple[WeightsFile, ...]:
    """Return the weights for ``ProviderSpec.weights``."""
    license = LICENSES[options.network] if options.weights is None else "unknown"
    return (WeightsFile(options.file, options.sha256, license),)
