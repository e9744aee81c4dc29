"""Wrappers, which modify the output of depth or normals providers."""

from __future__ import annotations

from mpsfm_core.providers.provider_kind import ProviderKind

KIND = ProviderKind(
    name="wrapper",
    title="Wrappers",
    protocol=None,
    checks="mpsfm_core.testing.checks.wrapper:CHECKS",
    capabilities={
        "wraps-depth": "The wrapper modifies the output of depth providers.",
        "wraps-normals": "The wrapper modifies the output of normals providers.",
    },
    predicts_maps=True,
)
