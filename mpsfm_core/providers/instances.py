"""Providers that a caller passes as Python objects instead of names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers.kinds import PROVIDER_KINDS, required_methods
from mpsfm_core.providers.protocols import Kind, ProviderContext, ProviderSpec


@dataclass(frozen=True, eq=False)
class ProviderInstance:
    """Provider factory that always returns the same object, which one thread at a time uses."""

    provider: object

    def __call__(self, options: Options | None, context: ProviderContext) -> object:
        """Return the provider object, whatever the provider context."""
        return self.provider


def spec_of_instance(kind: Kind, provider: Any) -> ProviderSpec:
    """Describe a provider object, so that a registry can list it.

    The attributes ``capabilities``, ``calibration`` and ``tags`` of the object are the fields of
    its :class:`~mpsfm_core.ProviderSpec`. A matcher object without the attribute ``capabilities``
    matches features.

    Args:
        kind: Kind of the provider, such as ``depth``.
        provider: Provider object with the method that the protocol of the kind requires, such as
            ``predict``.

    Returns:
        Specification of the provider, whose name is derived from the class of the object.

    Raises:
        ProviderError: The provider object is a class, or lacks the method that the kind requires.
    """
    if isinstance(provider, type):
        raise ProviderError(f"{kind}: {provider.__name__} is a class; pass {provider.__name__}()")
    for method in required_methods(kind):
        if not callable(getattr(provider, method, None)):
            raise ProviderError(
                f"{kind}: {type(provider).__name__} has no method {method}(); pass the name of a "
                f"provider, a configuration block, or an object with this method"
            )
    description = PROVIDER_KINDS[kind]
    capabilities = set(getattr(provider, "capabilities", description.default_capabilities))
    for capability, method in description.capability_methods.items():
        if callable(getattr(provider, method, None)):
            capabilities.add(capability)
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", type(provider).__name__).lower()
    return ProviderSpec(
        kind=kind,
        name=re.sub(r"[^a-z0-9]+", "-", words).strip("-") or kind,
        factory=ProviderInstance(provider),
        capabilities=frozenset(capabilities),
        calibration=getattr(provider, "calibration", None),
        tags=tuple(getattr(provider, "tags", ())),
        summary="object of the calling program",
    )
