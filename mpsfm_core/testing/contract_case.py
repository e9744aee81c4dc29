"""The provider under test, and what a check can ask of it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal
from weakref import WeakKeyDictionary, WeakSet

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import DepthPrior, Features, GroupPrior, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import Capability, Kind, ProviderContext, ProviderSpec, validation
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.testing.examples import Appearance, Example, indoor_example, outdoor_example
from mpsfm_core.testing.ground_truth_provider import GROUND_TRUTH_SPECS, GroundTruth
from mpsfm_core.testing.outcome import CheckSkipped

TruthSource = Literal["painted", "prepared", "image", "none"]

_RUN: Mapping[Kind, Callable[..., Any]] = MappingProxyType(
    {
        "depth": validation.run_depth,
        "features": validation.run_features,
        "retrieval": validation.run_retrieval,
        "mask": validation.run_mask,
    }
)

GIVEN_RELATIVE_STD = 0.02
"""Of the exact depth that a normals provider with ``needs-depth`` is given."""


@dataclass(frozen=True)
class ContractSetup:
    """How a provider is put under test, and from where it can know the right answer.

    ``options``: of the provider; without weights at hand, those of a stand-in network that the
    function in ``ProviderSpec.contract`` writes into the folder it is given:
    ``def contract(folder: Path) -> ContractSetup``.

    ``knows``, by default ``"image"`` for features, matchers and retrieval, else ``"none"``:

    * ``"painted"``: a stand-in network reads depth and normals from the colours of the views
      (:mod:`mpsfm_core.testing.painted_views`);
    * ``"prepared"``: ``tell`` is called with every example before the provider is asked about it, for
      instance to write files;
    * ``"image"``: the provider sees what is in a textured view, with real weights or without any;
    * ``"none"``: answers cannot be compared with the truth, and checks that would are skipped;
      ``tell``, where it is given, writes what the provider reads beside the view.

    ``expected_failures``: ids of checks that are known to fail, each with the reason; a check that
    then passes is a failure.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    truth_source: TruthSource | None = None
    prepare: Callable[[Example], None] | None = None
    expected_failures: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.truth_source == "prepared" and self.prepare is None:
            raise ValueError("truth_source='prepared' needs prepare")
        for check, reason in self.expected_failures.items():
            if not reason.strip():
                raise ValueError(f"expected failure of {check!r} needs a reason")


class ContractCase:
    """One provider under test.

    ``kind`` is that of its answers: a wrapper is tested once for each kind it wraps, around an
    oracle of that kind (``behaves_as``). The provider and the views are made when they are first
    needed, and kept. ``folder``: for the stand-ins of other providers that it works with.
    """

    def __init__(
        self,
        registry: Registry,
        spec: ProviderSpec,
        setup: ContractSetup,
        folder: Path,
        *,
        behaves_as: Kind | None = None,
        device: str = "cpu",
    ) -> None:
        self.registry = registry
        self.spec = spec
        self.kind: Kind = behaves_as or spec.kind
        self.setup = setup
        self._folder = folder
        self._device = device
        self._ground_truth = GroundTruth() if spec.kind == "wrapper" else None
        self._provider: Any = None
        self._prepared: WeakSet[Example] = WeakSet()
        self._detector: Any = None
        self._detected: WeakKeyDictionary[View, Features] = WeakKeyDictionary()
        self._main: Example | None = None

    @property
    def truth_source(self) -> TruthSource:
        """Where the provider can know the right answer from."""
        if self._ground_truth is not None:
            return "prepared"
        by_itself = self.kind in ("features", "matcher", "retrieval")
        return self.setup.truth_source or ("image" if by_itself else "none")

    def declares(self, capability: Capability) -> bool:
        """Whether the provider declares a capability."""
        return capability in self.spec.capabilities

    def require_truth(self, *sources: TruthSource) -> None:
        """Skip unless the provider knows the right answer from one of these sources."""
        if self.truth_source == "none":
            raise CheckSkipped(
                "no known answer: the provider has no stand-in that reads painted views, is not "
                "told the truth and is not said to see it (docs/contract.md)"
            )
        if self.truth_source not in sources:
            raise CheckSkipped(f"says nothing about a provider whose truth is {self.truth_source}")

    @property
    def example(self) -> Example:
        """The example that most checks ask about."""
        if self._main is None:
            look: Appearance = (
                "painted" if self.truth_source == "painted" or self._ground_truth else "textured"
            )
            outdoor = self.kind in ("depth", "normals", "multiview", "mask")
            self._main = outdoor_example(look) if outdoor else indoor_example(look)
        return self._main

    def create_provider(self, **inner: Any) -> Any:
        """A new instance of the provider; ``inner``: options of the oracle in a wrapper."""
        if self._ground_truth is None:
            return self._create(self.registry, self.kind, self.spec.name, self.setup.options)
        registry = Registry()
        oracle = GROUND_TRUTH_SPECS[self.kind]
        registry.add(self.spec, replace(oracle, factory=self._ground_truth.factory(self.kind)))
        wrapper = ProviderConfig(use=self.spec.name, options=dict(self.setup.options))
        return self._create(registry, self.kind, oracle.name, inner, (wrapper,))

    @property
    def provider(self) -> Any:
        """The instance that most checks ask."""
        if self._provider is None:
            self._provider = self.create_provider()
        return self._provider

    def run(self, example: Example, provider: Any = None) -> Any:
        """The provider's answer, validated; a matcher and a multi-view network are asked for the
        view and its partner."""
        self.prepare(example, *([example.partner] if self.kind in ("matcher", "multiview") else []))
        return self.run_on_view(example.view, example, provider)

    def run_on_view(
        self, view: View, example: Example, provider: Any = None, extra: Any = None
    ) -> Any:
        """The answer about a changed view of an example; everything else is the example's.

        ``extra``: what is handed in besides the view, by default what :meth:`extra` makes.
        """
        provider = self.provider if provider is None else provider
        extra = self.make_auxiliary_input(view, example) if extra is None else extra
        if self.kind == "matcher":
            views = (view, example.partner.view)
            return validation.run_matcher(self._rules, provider, views, extra)
        if self.kind == "multiview":
            views = (view, example.partner.view)
            return validation.run_multiview(self._rules, provider, views)
        if self.kind == "normals":
            return validation.run_normals(self._rules, provider, view, extra)
        run: Callable[[ProviderSpec, Any, View], Any] = _RUN[self.kind]
        return run(self._rules, provider, view)

    def make_auxiliary_input(self, view: View, example: Example) -> Any:
        """Depth for normals providers that need it, features for sparse matchers, else None."""
        if self.kind == "matcher":
            return self.features_of(view, example.partner.view)
        if self.kind != "normals" or not (self.declares("needs-depth") or self._ground_truth):
            return None
        truth = example.truth()
        variance = (GIVEN_RELATIVE_STD * truth.depth) ** 2
        return DepthPrior.from_arrays(truth.depth, variance, truth.valid)

    def run_on_pair(self, a: Example, b: Example) -> Any:
        """A matcher's answer about two examples."""
        self.prepare(a, b)
        views = (a.view, b.view)
        features = self.features_of(*views)
        return validation.run_matcher(self._rules, self.provider, views, features)

    def run_on_group(self, *examples: Example) -> GroupPrior:
        """A multi-view network's answer about several examples."""
        self.prepare(*examples)
        views = [example.view for example in examples]
        return validation.run_multiview(self._rules, self.provider, views)

    def prepare(self, *examples: Example) -> None:
        """Let the provider know the truth, if that is where it knows it from."""
        for example in examples:
            if example in self._prepared:
                continue
            self._prepared.add(example)
            if self._ground_truth is not None:
                self._ground_truth.add_example(example)
            if self.setup.prepare is not None:
                self.setup.prepare(example)

    def features_of(self, *views: View) -> Any:
        """Features for a sparse matcher, from the first detector of its family; else None."""
        if not self.declares("sparse"):
            return None
        return tuple(self._detect(view) for view in views)

    def received_depth(self) -> list[DepthPrior | None]:
        """The depth that a wrapper handed to the normals provider inside, at each question."""
        return [] if self._ground_truth is None else self._ground_truth.given_depth

    def calibration(self) -> Any:
        """The uncertainty model that a run would apply to the provider's answers."""
        options = dict(self.setup.options)
        if self._ground_truth is None:
            return self.registry.calibration(
                self.kind, ProviderConfig(use=self.spec.name, options=options)
            )
        wrapper = ProviderConfig(use=self.spec.name, options=options)
        registry = Registry()
        registry.add(self.spec, GROUND_TRUTH_SPECS[self.kind])
        inner = ProviderConfig(use=GROUND_TRUTH_SPECS[self.kind].name, wrap=(wrapper,))
        return registry.calibration(self.kind, inner)

    @property
    def _rules(self) -> ProviderSpec:
        """The specification that answers are validated against. A wrapper promises nothing of
        its own (what it has to keep is checked by name), and is given depth to hand on."""
        if self._ground_truth is None:
            return self.spec
        return replace(self.spec, capabilities=frozenset({"needs-depth"}))

    def _detect(self, view: View) -> Features:
        if view not in self._detected:
            spec = self._detector_spec()
            if self._detector is None:
                options = load_setup(spec, self._folder).options
                self._detector = self._create(self.registry, "features", spec.name, options)
            self._detected[view] = validation.run_features(spec, self._detector, view)
        return self._detected[view]

    def _detector_spec(self) -> ProviderSpec:
        """Of the matcher's family, if it has one, and then of its own plugin rather; else SIFT."""
        family = set(self.spec.tags)
        home = self.registry.version(self.spec.kind, self.spec.name)

        def less_fitting(name: str) -> bool:
            return self.registry.version("features", name) != home if family else name != "sift"

        for name in sorted(self.registry.names("features"), key=less_fitting):
            spec = self.registry.spec("features", name)
            if not family or family & set(spec.tags):
                return spec
        wanted = ", ".join(sorted(family)) or "any"
        raise ProviderError(f"no features provider of the family {wanted} is installed")

    def _create(
        self,
        registry: Registry,
        kind: Kind,
        name: str,
        options: Mapping[str, Any],
        wrap: tuple[ProviderConfig, ...] = (),
    ) -> Any:
        context = ProviderContext(WeightStore().resolve, device=self._device)
        return registry.create(kind, name, options, context, wrap)


def load_setup(spec: ProviderSpec, folder: Path) -> ContractSetup:
    """The setup that the plugin gives for the contract kit, or one of defaults.

    Raises :class:`~mpsfm_core.data.errors.ProviderError` when there is one and it cannot be made.
    """
    if spec.contract is None:
        return ContractSetup()
    try:
        if isinstance(spec.contract, str):
            module, _, name = spec.contract.partition(":")
            setup = getattr(importlib.import_module(module), name)(folder)
        else:
            setup = spec.contract(folder)
    except Exception as error:
        text = f"{spec.kind} provider {spec.name!r}: its contract {spec.contract!r} fails"
        raise ProviderError(f"{text}: {type(error).__name__}: {error}") from error
    if isinstance(setup, Mapping) and {part.name for part in fields(ContractSetup)}.issuperset(
        setup
    ):
        # from another environment
        setup = ContractSetup(**setup)
    if not isinstance(setup, ContractSetup):
        raise ProviderError(
            f"{spec.contract!r} returns a {type(setup).__name__}, not a ContractSetup"
        )
    return setup


def depth_in(answer: Any) -> DepthPrior:
    """The depth of the view that was asked about; in a group's answer the first."""
    prior: DepthPrior = answer.depth[0] if isinstance(answer, GroupPrior) else answer
    return prior


def collect_arrays(answer: object, name: str = "answer") -> dict[str, NDArray[Any]]:
    """All arrays and numbers in an answer by their path, to compare answers."""
    if isinstance(answer, np.ndarray):
        return {name: answer}
    if is_dataclass(answer) and not isinstance(answer, type):
        found: dict[str, NDArray[Any]] = {}
        for part in fields(answer):
            found |= collect_arrays(getattr(answer, part.name), f"{name}.{part.name}")
        return found
    if isinstance(answer, tuple):
        return {
            k: v for i, a in enumerate(answer) for k, v in collect_arrays(a, f"{name}[{i}]").items()
        }
    return {} if answer is None else {name: np.asarray(answer)}


def describe_difference(first: object, second: object) -> str:
    """Where two answers differ, or an empty text."""
    a, b = collect_arrays(first), collect_arrays(second)
    if a.keys() != b.keys():
        return f"one has {sorted(a)}, the other {sorted(b)}"
    for name, value in a.items():
        if value.shape != b[name].shape:
            return f"{name} has shape {value.shape} and {b[name].shape}"
        if not np.array_equal(value, b[name]):
            return f"{name} differs at {(value != b[name]).mean():.1%} of its values"
    return ""
