"""What a user can set, and what is known of the published weights. Imports nothing heavy."""

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
"""Of the published weights, from their cards."""


class DepthAnything3Options(Options):
    """Depth Anything 3 (2025) for any number of photos."""

    network: Network = "da3-small"
    """The authors' name of the architecture."""
    weights: str | None = None
    """A safetensors file, as path or URI; null for the authors' published one of the network."""
    sha256: str | None = None
    """Expected hash of it."""
    resize: int = Field(504, ge=28)
    """Longer side of the photos in pixels, rounded to multiples of 14 (authors' default)."""
    relative_std: float = Field(0.2, gt=0)
    """Std of depth for a confidence of 1, in terms of the mean depth of a group. Trained with
    ``confidence * error - alpha * log(confidence)`` a network says ``alpha / error``; the authors
    do not publish alpha, 0.2 is that of DUSt3R, which the loss is from."""

    @property
    def file(self) -> str:
        """The weights, named or published."""
        return self.weights or f"hf://depth-anything/{self.network.upper()}@main/model.safetensors"


def weights(options: Any) -> tuple[WeightsFile, ...]:
    """For ``ProviderSpec.weights``."""
    license = LICENSES[options.network] if options.weights is None else "unknown"
    return (WeightsFile(options.file, options.sha256, license),)
