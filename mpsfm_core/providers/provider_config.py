"""Configuration of one provider: name, options, wrappers, calibration and fallbacks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from mpsfm_core.data.options import Options

SAME_NETWORK = "same-network"
"""Name of a normals provider: use the normals that the depth network predicts in the same pass."""

FROM_MATCHER = "matcher"
"""Name of a depth provider: use the depth that the matcher predicts for its image pairs."""

FROM_MULTIVIEW = "multiview"
"""Name of a depth provider: use the depth that the multi-view network predicts for its groups."""


class ProviderConfig(Options):
    """Configuration of one provider, with fallback providers in order of preference."""

    use: str
    """Name of the provider, as ``mpsfm plugins list`` shows it."""
    fallback: tuple[str, ...] = ()
    """Fallback providers, tried in this order if ``use`` is unavailable: the plugin or its weights
    are missing, or the provider rejects the options."""
    environment: str | None = None
    """Python environment that contains the provider ``use`` (see ``mpsfm env create``). Validation
    merges the environment into the provider's name: ``use: NAME@ENVIRONMENT``."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the provider without its wrappers, validated by the provider's options class."""
    wrap: tuple[ProviderConfig, ...] = ()
    """Configurations of the wrappers around the provider, innermost first."""
    calibration: dict[str, Any] | str | None = None
    """Uncertainty model of a depth or normals provider: values, or the path of a YAML or JSON file.
    Null uses the uncertainty model that the plugin declares."""

    @model_validator(mode="before")
    @classmethod
    def _merge_environment(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and values.get("environment") and "use" in values:
            if values["use"] == SAME_NETWORK or "@" in str(values["use"]):
                raise ValueError(f"environment: 'use: {values['use']}' already selects one")
            values = {**values, "use": f"{values['use']}@{values['environment']}"}
            del values["environment"]
        return values

    @property
    def is_unresolved(self) -> bool:
        """True if several providers are possible and provider resolution has not chosen one.

        See :mod:`mpsfm_core.pipeline.provider_resolution`.
        """
        return bool(self.fallback) or self.use == SAME_NETWORK
