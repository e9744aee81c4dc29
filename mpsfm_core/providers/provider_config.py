"""Configuration of one provider with its options, wrappers and fallback providers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from mpsfm_core.data.options import Options

SAME_NETWORK = "same-network"
"""Name that selects, as normals provider, the network that already predicts the depth."""

FROM_MATCHER = "matcher"
"""Name of the depth provider that uses the depth that the matcher predicts for image pairs."""

FROM_MULTIVIEW = "multiview"
"""Name of the depth provider that uses the depth that a multi-view network predicts jointly for
several images."""


class ProviderConfig(Options):
    """Configuration of one provider, with fallback providers in order of preference.

    Examples:
        >>> ProviderConfig(use="files", options={"directory": "depth/"}).use
        'files'
    """

    use: str
    """Name of the provider, as in the output of ``mpsfm plugins list``. The form
    ``DISTRIBUTION:NAME`` selects the pip package if several packages have a provider of the same
    name."""
    fallback: tuple[str, ...] = ()
    """Names of fallback providers, tried in the given order if the provider ``use`` is unavailable.
    A provider is unavailable if its plugin or weights are missing, or if it rejects the options."""
    environment: str | None = None
    """Name of the Python environment that contains the provider ``use`` (see ``mpsfm env create``).
    Validation merges ``environment`` into the provider name ``use`` as ``NAME@ENVIRONMENT``."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the provider without its wrappers, validated by the provider's options class."""
    wrap: tuple[ProviderConfig, ...] = ()
    """Configurations of the wrapper providers that modify the provider's output, innermost
    first."""
    calibration: dict[str, Any] | str | None = None
    """Uncertainty model of a depth or normals provider, given by values or by the path of a YAML or
    JSON file. Null uses the uncertainty model that the plugin declares."""

    @model_validator(mode="before")
    @classmethod
    def _merge_environment(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and values.get("environment") and "use" in values:
            if values["use"] == SAME_NETWORK or "@" in str(values["use"]):
                raise ValueError(
                    f"environment: the provider 'use: {values['use']}' already selects an "
                    f"environment"
                )
            values = {**values, "use": f"{values['use']}@{values['environment']}"}
            del values["environment"]
        return values

    @property
    def is_unresolved(self) -> bool:
        """True if the configuration allows several providers and a run has to choose one of them.

        See :mod:`mpsfm_core.pipeline.provider_resolution`.
        """
        return bool(self.fallback) or self.use == SAME_NETWORK
