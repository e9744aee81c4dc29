"""Description of one provider kind, from which the code for all kinds is derived."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from mpsfm_core.data import View
from mpsfm_core.providers.protocols import Capability, Kind, ProviderSpec

COMMON_CAPABILITIES: Mapping[Capability, str] = {
    "intrinsics-aware": "The output of the provider depends on the intrinsics of the view.",
    "uncached": "The provider reads its output from files, so the run does not cache the output.",
}
"""Meaning of each capability that providers of every kind may declare."""

ExampleScene = Literal["outdoor", "indoor", "centered"]
"""Scene and camera of the synthetic views in contract checks: ``outdoor`` with a sky and an
off-centre principal point, ``indoor`` with texture everywhere, or ``centered``, which is
``outdoor`` with square pixels and a centered principal point."""


class CheckedProvider(Protocol):
    """Provider under test with its synthetic view, the argument of a contract check.

    :class:`mpsfm_core.testing.ContractCase` documents the methods.
    """

    @property
    def example(self) -> Any:
        """Synthetic view with ground truth, see :class:`mpsfm_core.testing.examples.Example`."""

    @property
    def truth_source(self) -> str:
        """Source from which the provider can derive the ground truth."""

    def run(self, example: Any) -> Any:
        """Run the provider on a synthetic view and validate the output."""

    def run_on_view(self, view: View, example: Any) -> Any:
        """Run the provider on a modified copy of a synthetic view and validate the output."""

    def require_truth(self, *sources: Any) -> None:
        """Skip the check unless the ground truth comes from one of the given sources."""

    def require_capability(self, capability: Capability) -> None:
        """Skip the check unless the provider declares a capability."""


@dataclass(frozen=True)
class ProviderKind:
    """Protocol, capabilities, validator, contract checks and template of one provider kind.

    Each module of :mod:`mpsfm_core.providers.kinds` contains one description with the name
    ``KIND``. A new module with a description adds a kind to the registry, the contract checks,
    ``mpsfm plugins new`` and the processes of other Python environments.
    """

    name: Kind
    """Name of the kind, such as ``depth``."""
    title: str
    """Heading of the contract checks of the kind in the documentation."""
    protocol: type | None
    """Protocol class of the provider objects. None for wrappers, which implement the protocol of
    the provider that they wrap."""
    checks: str
    """Tuple of the contract checks as ``"package.module:NAME"``, which is imported on first
    use."""
    capabilities: Mapping[Capability, str] = field(default_factory=dict)
    """Meaning of each capability that providers of the kind may declare, in addition to
    :data:`COMMON_CAPABILITIES`."""
    capability_methods: Mapping[Capability, str] = field(default_factory=dict)
    """Additional method that a provider must have, by the capability that requires the method."""
    default_capabilities: frozenset[Capability] = frozenset()
    """Capabilities of a provider object that a program passes without capabilities."""
    run: Callable[[ProviderSpec, Any, View], Any] | None = None
    """Function that calls the provider on one image and validates the output. None for kinds whose
    providers receive more than one image."""
    data_types: tuple[type, ...] = ()
    """Data classes of the kind that processes of other Python environments send and receive, in
    addition to those of :mod:`mpsfm_core.data`."""
    example_scene: ExampleScene = "outdoor"
    """Scene and camera of the synthetic view that most contract checks use."""
    predicts_maps: bool = False
    """True if the output is a map with a value for each pixel."""
    sees_truth: bool = False
    """True if a provider without weights can derive the correct output from textured views."""
    compare: Callable[[CheckedProvider, Any, Any], str] | None = None
    """Function ``compare(case, example, output)`` that returns the measured error of an output, or
    raises DataError if the error is too large. None for kinds that
    :mod:`mpsfm_core.testing.accuracy` compares."""
    template: Mapping[str, str] = field(default_factory=dict)
    """Text of each template file by file name, for ``mpsfm plugins new``. If empty, the template is
    a folder of ``mpsfm_core/testing/templates``."""
    template_requirements: tuple[str, ...] = ()
    """Python packages that the template requires in addition to mpsfm-core and numpy."""
