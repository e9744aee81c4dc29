"""Provider kinds: one module for each kind, with the description ``KIND``.

The module of a kind contains the protocol of the providers, the functions that call a provider and
validate its output, and a :class:`~mpsfm_core.providers.provider_kind.ProviderKind`.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType

from mpsfm_core.providers.protocols import Capability, Kind
from mpsfm_core.providers.provider_kind import COMMON_CAPABILITIES, ProviderKind

PROVIDER_KINDS: Mapping[Kind, ProviderKind] = MappingProxyType(
    {
        module.name: importlib.import_module(f"{__name__}.{module.name}").KIND
        for module in sorted(pkgutil.iter_modules(__path__), key=lambda module: module.name)
    }
)
"""Description of each provider kind by name. The name of a kind is the name of its module."""

KINDS: tuple[Kind, ...] = tuple(PROVIDER_KINDS)
"""Names of all provider kinds."""

CAPABILITIES: tuple[Capability, ...] = tuple(
    dict.fromkeys(
        capability
        for meanings in (COMMON_CAPABILITIES, *(k.capabilities for k in PROVIDER_KINDS.values()))
        for capability in meanings
    )
)
"""Names of all capabilities that a provider may declare."""


def required_methods(kind: Kind, capabilities: frozenset[Capability] = frozenset()) -> list[str]:
    """List the methods that a provider of a kind must have, given its capabilities."""
    description = PROVIDER_KINDS[kind]
    protocol = vars(description.protocol) if description.protocol else {}
    return [name for name in protocol if not name.startswith("_")] + [
        method
        for capability, method in description.capability_methods.items()
        if capability in capabilities
    ]
