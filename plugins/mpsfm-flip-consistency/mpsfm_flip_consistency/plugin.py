"""Registration of the flip-consistency wrapper for depth and normals providers."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register the flip-consistency wrapper for depth providers and normals providers."""
    return [
        ProviderSpec(
            kind="wrapper",
            name="flip-consistency",
            factory="mpsfm_flip_consistency.wrapper:FlipConsistency",
            capabilities=frozenset({"wraps-depth", "wraps-normals"}),
            summary="second pass on the mirrored image: mean, and variance from the difference",
            code_license="Apache-2.0",
        )
    ]
