"""Provider under test with its ContractSetup, which is called on synthetic views."""

from __future__ import annotations

import hashlib
import importlib
import pickle
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Features, MultiViewPrior, PinholeCamera, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import (
    PROVIDER_KINDS,
    Capability,
    Kind,
    ProviderContext,
    ProviderKind,
    ProviderSpec,
)
from mpsfm_core.providers.kinds.features import run_features
from mpsfm_core.providers.kinds.matcher import run_matcher
from mpsfm_core.providers.kinds.multiview import run_multiview
from mpsfm_core.providers.kinds.normals import run_normals
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.lru_cache import LruCache
from mpsfm_core.support.time_limit import time_limit
from mpsfm_core.testing.examples import (
    Appearance,
    Example,
    TrueMaps,
    indoor_example,
    outdoor_example,
)
from mpsfm_core.testing.ground_truth_provider import (
    GROUND_TRUTH_SPECS,
    GroundTruth,
    GroundTruthOptions,
)
from mpsfm_core.testing.observed_instance import ObservedInstance, observe_instance
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped, CheckUnmeasured
from mpsfm_core.testing.painted_views import depth_unit, normal_colors, paint_normals
from mpsfm_core.testing.process_state import read_process_settings

TruthSource = Literal["painted", "prepared", "image", "none"]
"""Source of the ground truth for a provider under test, see :class:`ContractSetup`."""

CALL_TIMEOUT_S = 60.0
"""Time in seconds after which a call or the construction of a provider is interrupted. The check
``speed`` fails after 20 s, and large views take longer than the views of this check."""
_NUM_DETECTIONS = 96
"""Number of views whose features a process stores for sparse matchers with the same detector."""
_NUM_FEATURES = 300
"""Largest number of features of a view that a sparse matcher receives in most checks. AdaLAM
and LighterGlue take up to three times as long for the 734 SIFT features of a 192 x 144 view."""
_MAX_ANSWER_BYTES = 100_000_000
"""Total size in bytes of the outputs of a provider that later checks reuse."""
AUXILIARY_RELATIVE_STD = 0.02
"""Relative std of the exact depth prior that a normals provider with ``needs-depth`` receives."""


@dataclass(frozen=True)
class ContractSetup:
    """Declaration of how to test a provider: its options and the source of the ground truth.

    A plugin returns a ContractSetup from the function ``contract(folder)`` that
    ``ProviderSpec.contract`` names. The argument ``folder`` is an empty temporary folder for test
    weights.

    The attribute ``truth_source`` has one of four values. The truth source ``"painted"`` means that
    a tiny test network decodes depth and normals from the colors of the views, see
    :mod:`mpsfm_core.testing.painted_views`. The truth source ``"prepared"`` means that the function
    ``prepare`` writes the ground truth to files, for providers that read files. The truth source
    ``"image"`` means that the correct output follows from a textured view, with or without real
    weights. The truth source ``"none"`` means that the ground truth is unknown, so checks that
    compare with the ground truth are skipped.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the provider under test. The options usually name the file with weights of a tiny
    test network."""
    truth_source: TruthSource | None = None
    """Source of the ground truth, by default ``"image"`` for features, matchers and retrieval, and
    ``"none"`` for other provider kinds."""
    prepare: Callable[[Example], None] | None = None
    """Function that is called with each synthetic view before the provider runs on the view, for
    instance to write the depth ``example.truth().depth`` to a file."""
    expected_failures: Mapping[str, str] = field(default_factory=dict)
    """Reason of each expected failure by the id of the contract check. If a provider passes a check
    that is expected to fail, the check is reported as failed."""

    def __post_init__(self) -> None:
        if self.truth_source == "prepared" and self.prepare is None:
            raise ValueError("truth_source='prepared' requires the function prepare")
        for check, reason in self.expected_failures.items():
            if not reason.strip():
                raise ValueError(f"expected failure of {check!r} needs a reason")


class ContractCase:
    """Provider under test, the argument of every contract check.

    The attribute ``kind`` is the provider kind of the output, which a wrapper shares with the
    provider that it wraps. A wrapper is tested once for each kind that it wraps, around a provider
    that returns the ground truth. The provider and the synthetic views are created on first use and
    reused by later checks.
    """

    def __init__(
        self,
        registry: Registry,
        spec: ProviderSpec,
        setup: ContractSetup,
        folder: Path,
        *,
        name: str | None = None,
        behaves_as: Kind | None = None,
        device: str = "cpu",
        make_setup: Callable[[Path], ContractSetup] | None = None,
    ) -> None:
        """Create the contract case without constructing the provider.

        Args:
            registry: Registry of the installed providers.
            spec: Specification of the provider.
            setup: ContractSetup of the provider under test.
            folder: Folder for the files of helper providers, such as a detector for a matcher.
            name: Name of the provider in the registry, by default the name in the specification.
            behaves_as: Kind of the provider inside a wrapper, or None if the provider under test is
                not a wrapper.
            device: ``"cpu"`` or ``"cuda"``.
            make_setup: Function that returned ``setup`` for a folder. By default, ``setup`` is used
                in every folder.
        """
        self.registry = registry
        self.spec = spec
        self.kind: Kind = behaves_as or spec.kind
        self.setup = setup
        self.name = name or spec.name
        """Name of the provider in the registry, which may be ``DISTRIBUTION:NAME``."""
        self._folder = folder
        self._device = device
        self._make_setup = make_setup or (lambda folder: setup)
        self._ground_truth = GroundTruth() if spec.kind == "wrapper" else None
        self._prepared: WeakSet[Example] = WeakSet()
        self._detector: Any = None
        self._example: Example | None = None
        self._resolved: set[str] = set()
        self._answers: LruCache[bytes, Any] = LruCache(_MAX_ANSWER_BYTES, _count_bytes)
        self.process_before = read_process_settings()
        """Global settings of this process before the first instance of the provider was created."""

    @property
    def truth_source(self) -> TruthSource:
        """Source of the ground truth for the provider under test."""
        if self._ground_truth is not None:
            return "prepared"
        return self.setup.truth_source or ("image" if self.description.sees_truth else "none")

    def declares(self, capability: Capability) -> bool:
        """Return whether the specification of the provider lists a capability."""
        return capability in self.spec.capabilities

    @property
    def description(self) -> ProviderKind:
        """Description of the provider kind of the output."""
        return PROVIDER_KINDS[self.kind]

    def require_capability(self, capability: Capability) -> None:
        """Skip the check unless the specification of the provider lists a capability.

        Raises:
            CheckSkipped: the provider does not declare the capability.
        """
        if not self.declares(capability):
            raise CheckSkipped(f"the provider does not declare {capability!r}")

    def require_truth(self, *sources: TruthSource) -> None:
        """Skip the check unless the ground truth comes from one of the given sources.

        Raises:
            CheckSkipped: the ground truth comes from another source.
            CheckUnmeasured: the ground truth is unknown.
        """
        if self.truth_source == "none":
            raise CheckUnmeasured(
                "the ground truth is unknown: declare a truth_source in the ContractSetup "
                "(docs/contract.md)"
            )
        if self.truth_source not in sources:
            raise CheckSkipped(f"the check does not apply to truth_source={self.truth_source!r}")

    @property
    def example(self) -> Example:
        """Synthetic view that most checks use: 192 x 144 pixels, painted or textured."""
        if self._example is None:
            is_painted = self.truth_source == "painted" or self._ground_truth is not None
            appearance: Appearance = "painted" if is_painted else "textured"
            scene = self.description.example_scene
            # Providers can see the holes of a mask in painted views only.
            has_holes = self.kind != "mask" or self.truth_source != "image"
            if scene == "indoor":
                self._example = indoor_example(appearance)
            elif scene == "outdoor":
                self._example = outdoor_example(appearance, holes=has_holes)
            else:
                self._example = outdoor_example(appearance).with_common_camera()
        return self._example

    @cached_property
    def small_example(self) -> Example:
        """Synthetic view of 104 x 120 pixels, for checks that do not depend on the image size."""
        return self.example.sized(104, 120)

    @property
    def example_sequence(self) -> tuple[Example, ...]:
        """Synthetic views in the order of the calls of :attr:`observed`.

        The sequence starts with a view of another size than :attr:`example`, because a provider may
        store values of the first view.
        """
        return self.small_example, self.example.partner, self.example

    def create_provider(self, num_wrappers: int = 1, **inner_options: Any) -> Any:
        """Construct a new instance of the provider under test.

        Args:
            num_wrappers: Number of instances that wrap each other, for a wrapper.
            inner_options: Options of the ground-truth provider inside a wrapper, see
                :class:`~mpsfm_core.testing.ground_truth_provider.GroundTruthOptions`.
        """
        if self._ground_truth is None:
            return self._create(self.registry, self.kind, self.name, self.setup.options)
        registry = Registry()
        inner = GROUND_TRUTH_SPECS[self.kind]
        registry.add(self.spec, replace(inner, factory=self._ground_truth.factory(self.kind)))
        wrapper = ProviderConfig(use=self.spec.name, options=dict(self.setup.options))
        return self._create(
            registry, self.kind, inner.name, inner_options, num_wrappers * (wrapper,)
        )

    def run_in_depth_unit(self, meters: float) -> Any:
        """Run the provider on the example view, whose colors encode larger or smaller depth.

        Args:
            meters: Factor by which the test network's depth is larger than in :meth:`run`.
        """
        with depth_unit(meters), tempfile.TemporaryDirectory(dir=self._folder) as folder:
            options = self._make_setup(Path(folder)).options
            provider = self._create(self.registry, self.kind, self.name, options)
            return self.run(self.example, provider)

    def file_options(self) -> dict[str, Path]:
        """Return the options of the ContractSetup that name an existing file."""
        texts = {k: v for k, v in self.setup.options.items() if isinstance(v, (str, Path)) and v}
        return {key: Path(value) for key, value in texts.items() if Path(value).is_file()}

    def with_options(self, **changes: Any) -> ContractCase:
        """Return a contract case of the same provider with other options."""
        return ContractCase(
            self.registry,
            self.spec,
            replace(self.setup, options={**self.setup.options, **changes}),
            self._folder,
            name=self.name,
            behaves_as=self.kind if self.spec.kind == "wrapper" else None,
            device=self._device,
        )

    def require_resolved_weights(self) -> None:
        """Require that the provider opened its weights files by ``context.resolve_weights``.

        Raises:
            CheckFailed: the provider did not ask for a weights file of its specification.
        """
        if missing := self._find_unresolved_weights():
            self.run(self.example)
            missing = self._find_unresolved_weights()
        if missing:
            raise CheckFailed(f"the provider opens {missing[0]} without context.resolve_weights")

    def _find_unresolved_weights(self) -> list[str]:
        """List the declared weights files that the provider has not asked for."""
        options = self.registry.validate_options(self.spec.kind, self.name, self.setup.options)
        declared = self.spec.weights
        files = declared(options) if callable(declared) else declared
        # A constant declaration names the real weights, which the test weights may replace.
        if self._resolved and not callable(declared):
            return []
        return [file.uri for file in files if str(file.uri) not in self._resolved]

    def run_with_normal_colors(self, example: Example) -> tuple[Any, TrueMaps]:
        """Run the provider on a view whose colors encode x, y and z of the normals.

        Returns:
            The output of the provider and the ground truth of the view.
        """
        truth = example.truth()
        view = replace(example.view, image=paint_normals(truth.normals))
        with normal_colors(), tempfile.TemporaryDirectory(dir=self._folder) as folder:
            options = self._make_setup(Path(folder)).options
            provider = self._create(self.registry, self.kind, self.name, options)
            return self.run_on_view(view, example, provider), truth

    @cached_property
    def provider(self) -> Any:
        """Instance of the provider under test that all checks share."""
        return self.create_provider()

    @cached_property
    def observed(self) -> ObservedInstance:
        """Second instance of the provider under test, with the recorded effects of its calls."""
        self.run(self.example)  # imports the provider's libraries, which may change the process
        calls = [self._prepare_call(example) for example in self.example_sequence]
        return observe_instance(self.create_provider, calls, self.process_before)

    def _prepare_call(self, example: Example) -> Callable[[Any], Any]:
        """Return a function that calls a provider instance with a view and its prepared inputs."""
        self.prepare(example, *([example.partner] if self._uses_pair else []))
        auxiliary = self.make_auxiliary_input(example.view, example)
        return lambda provider: self.run_on_view(example.view, example, provider, auxiliary)

    def run(self, example: Example, provider: Any = None) -> Any:
        """Run the provider on a synthetic view and validate the output.

        Args:
            example: The example. Matchers and multi-view providers also receive the view
                ``example.partner``.
            provider: Provider instance, by default as in :meth:`run_on_views`.
        """
        self.prepare(example, *([example.partner] if self._uses_pair else []))
        return self.run_on_view(example.view, example, provider)

    def run_on_view(
        self, view: View, example: Example, provider: Any = None, auxiliary: Any = None
    ) -> Any:
        """Run the provider on a modified copy of a synthetic view and validate the output.

        Args:
            view: Modified image that replaces the image ``example.view``.
            example: Synthetic view that supplies all inputs of the provider except the image.
            provider: Provider instance, by default as in :meth:`run_on_views`.
            auxiliary: Depth or features for the provider, by default from
                :meth:`make_auxiliary_input`.
        """
        auxiliary = self.make_auxiliary_input(view, example) if auxiliary is None else auxiliary
        views = (view, example.partner.view) if self._uses_pair else (view,)
        return self.run_on_views(views, auxiliary, provider)

    def run_on_examples(self, *examples: Example) -> Any:
        """Match a pair of synthetic views, or predict depth of a group, and validate the output."""
        self.prepare(*examples)
        return self.run_on_views([example.view for example in examples])

    def run_on_views(
        self, views: Sequence[View], auxiliary: Any = None, provider: Any = None
    ) -> Any:
        """Run the provider on an image, a pair or a group of images and validate the output.

        Args:
            views: Two images for a matcher, one or more for a multi-view provider, otherwise one.
            auxiliary: Depth of a normals provider, or features of both images for a sparse matcher,
                which are detected by default.
            provider: Provider instance to call. By default, the instance that all checks share is
                called once for equal inputs, and later checks get the same output.
        """
        if self.kind == "matcher" and auxiliary is None:
            auxiliary = self.extract_features(*views)
        if provider is None:
            key = hashlib.blake2b(pickle.dumps((views, auxiliary))).digest()
            return self._answers.get(
                key, lambda: self.run_on_views(views, auxiliary, self.provider)
            )
        with time_limit(CALL_TIMEOUT_S, "a call of the provider"):
            return self._call(provider, views, auxiliary)

    def _call(self, provider: Any, views: Sequence[View], auxiliary: Any) -> Any:
        """Call a provider instance and validate the output."""
        if self.kind == "matcher":
            return run_matcher(self._validated_spec, provider, (views[0], views[1]), auxiliary)
        if self.kind == "multiview":
            return run_multiview(self._validated_spec, provider, views)
        if self.kind == "normals":
            return run_normals(self._validated_spec, provider, views[0], auxiliary)
        run = self.description.run
        assert run is not None
        return run(self._validated_spec, provider, views[0])

    def make_auxiliary_input(self, view: View, example: Example) -> Any:
        """Return the input depth of a normals provider or features of a sparse matcher."""
        if self.kind == "matcher":
            return self.extract_features(view, example.partner.view)
        if self.kind != "normals" or not (self.declares("needs-depth") or self._ground_truth):
            return None
        truth = example.truth()
        variance = (AUXILIARY_RELATIVE_STD * truth.depth) ** 2
        return DepthPrior.from_arrays(truth.depth, variance, truth.valid)

    def prepare(self, *examples: Example) -> None:
        """Prepare the ground truth of each synthetic view once."""
        for example in examples:
            if example in self._prepared:
                continue
            self._prepared.add(example)
            if self._ground_truth is not None:
                self._ground_truth.add_example(example)
            if self.setup.prepare is not None:
                self.setup.prepare(example)

    def extract_features(self, *views: View, max_count: int = _NUM_FEATURES) -> Any:
        """Detect the strongest features for a sparse matcher; return None for other providers."""
        if not self.declares("sparse"):
            return None
        return tuple(_select_strongest(self._detect(view), max_count) for view in views)

    def received_depth(self) -> list[bool]:
        """Return whether each call of a wrapped normals provider received a depth prior."""
        return [] if self._ground_truth is None else self._ground_truth.received_depth

    def run_inner(self, view: View) -> Any:
        """Return the output of the provider inside a wrapper."""
        assert self._ground_truth is not None
        make = self._ground_truth.factory(self.kind)
        provider: Any = make(GroundTruthOptions(), ProviderContext(WeightStore().resolve))
        return provider.predict(view)

    def to_pickle(self) -> tuple[Any, ...]:
        """Return the values from which :func:`restore_case` creates an equal contract case.

        The other process can read the files that ``ContractSetup.prepare`` wrote.
        """
        spec = replace(self.spec, contract=None, weights=())
        source = "none" if self.truth_source == "prepared" else self.truth_source
        setup = ContractSetup(self.setup.options, source)
        return spec, setup, self._folder, self.kind, self._device

    @contextmanager
    def received_mask(self, mask: Bool) -> Iterator[None]:
        """Pass the mask of the input view to the ground-truth provider in a ``with`` block."""
        assert self._ground_truth is not None
        self._ground_truth.mask = mask
        self._ground_truth.returned.clear()
        try:
            yield
            if any(pickle.dumps(prior) != before for prior, before in self._ground_truth.returned):
                self._ground_truth.wrong_inputs.append(
                    "a prior of its own that the wrapper changed"
                )
        finally:
            self._ground_truth.mask = None

    def wrong_inputs(self) -> list[str]:
        """Return the errors of views and depth priors that a wrapper passed to its provider."""
        return [] if self._ground_truth is None else self._ground_truth.wrong_inputs

    def calibration(self) -> Any:
        """Return the uncertainty model that a run would apply to the provider's output."""
        options = dict(self.setup.options)
        if self._ground_truth is None:
            return self.registry.calibration(
                self.kind, ProviderConfig(use=self.name, options=options)
            )
        wrapper = ProviderConfig(use=self.spec.name, options=options)
        registry = Registry()
        registry.add(self.spec, GROUND_TRUTH_SPECS[self.kind])
        inner = ProviderConfig(use=GROUND_TRUTH_SPECS[self.kind].name, wrap=(wrapper,))
        return registry.calibration(self.kind, inner)

    @property
    def _uses_pair(self) -> bool:
        """True if the provider receives an example together with its partner."""
        return self.kind in ("matcher", "multiview")

    @property
    def _validated_spec(self) -> ProviderSpec:
        """Specification of the provider, from which the validator reads the capabilities.

        For a wrapper, the specification omits the capabilities of the wrapped provider, because
        separate checks test what a wrapper keeps.
        """
        if self._ground_truth is None:
            return self.spec
        return replace(self.spec, capabilities=frozenset({"needs-depth"}))

    def _detect(self, view: View) -> Features:
        spec = self._detector_spec
        digest = hashlib.blake2b(view.image.tobytes()).digest()
        detection = _Detection(spec, digest, view.camera, self._device, view, self._create_detector)
        return deepcopy(_detect_once(detection))

    def _create_detector(self, spec: ProviderSpec) -> Any:
        """Return the detector of a sparse matcher, which all detections of the case share."""
        if self._detector is None:
            options = load_setup(spec, self._folder).options
            self._detector = self._create(self.registry, "features", spec.name, options)
        return self._detector

    @cached_property
    def _detector_spec(self) -> ProviderSpec:
        """Detector of the matcher's family and plugin, or SIFT without a family."""
        family = set(self.spec.tags)
        plugin = self.registry.version(self.spec.kind, self.name)

        def is_second_choice(name: str) -> bool:
            version = self.registry.version("features", name)
            return version != plugin if family else name != "sift"

        for name in sorted(self.registry.names("features"), key=is_second_choice):
            spec = self.registry.spec("features", name)
            if not family or family & set(spec.tags):
                return spec
        families = ", ".join(sorted(family)) or "any"
        raise ProviderError(f"no features provider of the family {families} is installed")

    def _create(
        self,
        registry: Registry,
        kind: Kind,
        name: str,
        options: Mapping[str, Any],
        wrap: tuple[ProviderConfig, ...] = (),
    ) -> Any:
        resolve = WeightStore().resolve

        def record(uri: str, sha256: str | None = None) -> Path:
            self._resolved.add(str(uri))
            return resolve(uri, sha256)

        context = ProviderContext(record, device=self._device)
        with time_limit(CALL_TIMEOUT_S, "the constructor of the provider"):
            return registry.create(kind, name, options, context, wrap)


@dataclass(frozen=True)
class _Detection:
    """Input of a feature detector, which is equal for equal pixels, camera and detector."""

    spec: ProviderSpec
    digest: bytes
    camera: PinholeCamera
    device: str
    view: View = field(compare=False)
    create: Callable[[ProviderSpec], Any] = field(compare=False)


@lru_cache(maxsize=_NUM_DETECTIONS)
def _detect_once(detection: _Detection) -> Features:
    """Detect the features of a view, of which each call of a provider receives a copy."""
    detector = detection.create(detection.spec)
    return run_features(detection.spec, detector, detection.view)


def _select_strongest(features: Features, max_count: int) -> Features:
    """Select the features with the highest scores or largest scales, without changing the order."""
    strength = features.scales if features.scores is None else features.scores
    if len(features) <= max_count or strength is None:
        return features.select(np.arange(min(len(features), max_count)))
    return features.select(np.sort(np.argsort(-strength, kind="stable")[:max_count]))


def restore_case(
    spec: ProviderSpec, setup: ContractSetup, folder: Path, kind: Kind, device: str
) -> ContractCase:
    """Create a contract case from the values of :meth:`ContractCase.to_pickle`."""
    registry = Registry()
    registry.add(spec)
    behaves_as = kind if spec.kind == "wrapper" else None
    return ContractCase(registry, spec, setup, folder, behaves_as=behaves_as, device=device)


def load_setup(spec: ProviderSpec, folder: Path) -> ContractSetup:
    """Return the ContractSetup that a plugin declares for its provider, or the default one.

    Args:
        spec: Specification of the provider.
        folder: Folder for the weights files of test networks.

    Returns:
        The setup.

    Raises:
        ProviderError: the contract function raises an exception or returns another type.
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
    if isinstance(setup, Mapping):
        # A provider in another Python environment sends its ContractSetup as a mapping.
        names = {part.name for part in fields(ContractSetup)}
        setup = ContractSetup(**setup) if names.issuperset(setup) else setup
    if not isinstance(setup, ContractSetup):
        raise ProviderError(
            f"{spec.contract!r} returns a {type(setup).__name__}, not a ContractSetup"
        )
    return setup


def first_depth(answer: Any) -> DepthPrior:
    """Return the depth prior in a provider's output, for a group of views the first prior."""
    prior: DepthPrior = answer.depth[0] if isinstance(answer, MultiViewPrior) else answer
    return prior


def collect_arrays(answer: object, name: str = "answer") -> dict[str, NDArray[Any]]:
    """Collect the arrays and numbers of an output by their path, such as ``answer.depth``."""
    if isinstance(answer, np.ndarray):
        return {name: answer}
    if is_dataclass(answer) and not isinstance(answer, type):
        arrays: dict[str, NDArray[Any]] = {}
        for part in fields(answer):
            arrays |= collect_arrays(getattr(answer, part.name), f"{name}.{part.name}")
        return arrays
    if isinstance(answer, tuple):
        entries = enumerate(answer)
        return {k: v for i, a in entries for k, v in collect_arrays(a, f"{name}[{i}]").items()}
    return {} if answer is None else {name: np.asarray(answer)}


def _count_bytes(answer: object) -> int:
    """Return the size of the arrays in an output."""
    return sum(value.nbytes for value in collect_arrays(answer).values())


def describe_difference(first: object, second: object) -> str:
    """Describe the first difference between two outputs, or return an empty text."""
    a, b = collect_arrays(first), collect_arrays(second)
    if a.keys() != b.keys():
        return f"one has {sorted(a)}, the other {sorted(b)}"
    for name, value in a.items():
        if value.shape != b[name].shape:
            return f"{name} has shape {value.shape} and {b[name].shape}"
        if not np.array_equal(value, b[name]):
            return f"{name} differs at {(value != b[name]).mean():.1%} of its values"
    return ""
