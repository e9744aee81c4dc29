"""What a provider is: the protocols, the specification a plugin registers, and the hooks.

A plugin is an installed package with an entry point in the group ``mpsfm.plugins``. The entry
point names a light module (it must not import torch, onnxruntime or the like) that implements the
hook :func:`Hooks.mpsfm_providers`::

    from mpsfm_core import ProviderSpec, hookimpl

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec(kind="depth", name="my-depth", factory="my_package.model:MyDepth")]

The factory is called as ``factory(options, context)`` (a wrapper's as
``factory(inner, options, context)``) when the provider is first used. What it returns must have
the method of its kind's protocol below.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import pluggy
from pydantic import BaseModel

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Features,
    Float32,
    GroupPrior,
    NormalPrior,
    PairMatches,
    SceneState,
    View,
)
from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

API_VERSION = 1
"""Version of this contract. A plugin that names a newer one is listed as unavailable."""

ENTRY_POINT_GROUP = "mpsfm.plugins"

Kind = Literal[
    "depth", "normals", "multiview", "features", "matcher", "retrieval", "mask", "wrapper"
]
KINDS: tuple[Kind, ...] = get_args(Kind)

Capability = Literal[
    "metric",  # depth in metres
    "variance",  # depth or normals come with a variance from the network
    "joint-normals",  # depth provider that also has predict_joint()
    "needs-depth",  # normals provider that wants the depth prior of the view
    "sparse",  # matcher that needs features and returns sparse matches
    "dense",  # matcher that works on the views alone and returns dense matches
    "pair-depth",  # matcher that returns depth of both views
    "wraps-depth",  # wrapper for depth providers
    "wraps-normals",  # wrapper for normals providers
    "intrinsics-aware",  # the output depends on the focal length
    "estimates-focal",  # depth provider that also has estimate_focal()
    "proposes-poses",  # multi-view provider that says how the views lie to each other
    "proposes-intrinsics",  # multi-view provider that says the intrinsics of the views
    "uncached",  # reads its output from files: nothing is kept, and a changed file is seen
]
CAPABILITIES: tuple[Capability, ...] = get_args(Capability)


@dataclass(frozen=True)
class ProviderContext:
    """What the core gives a provider's factory.

    ``device``: ``"cpu"`` or ``"cuda"``, already resolved. ``threads``: how many the provider may
    use. ``seed``: for anything random. ``resolve_weights(uri, sha256)``: local path of a weights
    file (see :mod:`mpsfm_core.providers.weights`); raises
    :class:`~mpsfm_core.data.errors.WeightsError`. """

    resolve_weights: Callable[[str, str | None], Path]
    device: str = "cpu"
    threads: int = 1
    seed: int = 0


@runtime_checkable
class DepthProvider(Protocol):
    """Predicts z-depth of a view on a grid of its own size that covers the view."""

    def predict(self, view: View) -> DepthPrior: ...


@runtime_checkable
class JointProvider(DepthProvider, Protocol):
    """A depth provider whose network gives normals in the same pass (``joint-normals``)."""

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]: ...


@runtime_checkable
class FocalEstimator(DepthProvider, Protocol):
    """A depth provider that can tell the focal length of a view (``estimates-focal``)."""

    def estimate_focal(self, view: View) -> float | None:
        """In pixels of the view, whatever its camera says; None where there is no telling."""
        ...


@runtime_checkable
class NormalsProvider(Protocol):
    """Predicts normals of a view; ``depth`` is given when the spec says ``needs-depth``."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior: ...


@runtime_checkable
class MultiViewProvider(Protocol):
    """Predicts the depth of several views at once, in one unit, and maybe how they lie.

    ``views``: one or more of one scene, of any sizes. A map may have a grid of its own that covers
    its view.
    """

    def predict_group(self, views: Sequence[View]) -> GroupPrior: ...


@runtime_checkable
class FeatureProvider(Protocol):
    """Detects and describes sparse features of a view."""

    def extract(self, view: View) -> Features: ...


@runtime_checkable
class Matcher(Protocol):
    """Matches two views; features are given when the spec says ``sparse``."""

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches: ...


def require_features(
    purpose: str, features_a: Features | None, features_b: Features | None
) -> tuple[Features, Features]:
    """The features of both views, for a matcher that cannot do without.

    ``purpose``: beginning of the message, as "mutual-nearest matches features". Raises
    ProviderError when there are none.
    """
    if features_a is None or features_b is None:
        raise ProviderError(f"{purpose}: choose a features provider")
    return features_a, features_b


@runtime_checkable
class RetrievalProvider(Protocol):
    """Describes a view by one (d,) float32 vector; similarity is the dot product."""

    def describe(self, view: View) -> Float32: ...


@runtime_checkable
class MaskProvider(Protocol):
    """Returns (H, W) bool on the view's grid, True where the pixel may be used."""

    def mask(self, view: View) -> Bool: ...


class Executor(Protocol):
    """Runs steps of the extraction on workers elsewhere."""

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Run ``step(item)`` for all items; yields once for each that is done, in any order.

        Step and items can be pickled; what a step finds out it leaves in the cache. A step whose
        worker was lost runs again on another. Raises what a step raised. Closing the iterator drops
        what has not begun.
        """
        ...

    def close(self) -> None:
        """Let go of the workers."""
        ...


PROTOCOLS: dict[Kind, type] = {
    "depth": DepthProvider,
    "normals": NormalsProvider,
    "multiview": MultiViewProvider,
    "features": FeatureProvider,
    "matcher": Matcher,
    "retrieval": RetrievalProvider,
    "mask": MaskProvider,
}
"""The protocol of each kind (a wrapper returns a provider of the kind it wraps)."""


CAPABILITY_METHODS: dict[Capability, str] = {
    "joint-normals": "predict_joint",
    "estimates-focal": "estimate_focal",
}
"""The further method that a provider with the capability must have."""


@dataclass(frozen=True)
class WeightsFile:
    """A weights file that a provider loads.

    ``uri``: see :mod:`mpsfm_core.providers.weights`. ``sha256``: hex digest, or None where the
    publisher gives none (it is then recorded at first use). ``license``: SPDX id or a short text.
    ``size``: in bytes, None where it is not known; told before a download. """

    uri: str
    sha256: str | None = None
    license: str = "unknown"
    size: int | None = None


def weights_from_option(
    option: str, *known: WeightsFile, sha256: str = "sha256"
) -> Callable[[Any], tuple[WeightsFile, ...]]:
    """For :attr:`ProviderSpec.weights`: the file that an option of the provider names.

    ``option``: its name, whose value is a path or URI, or None for no file. ``sha256``: the option
    with the expected hash. ``known``: what is known of files that it may name, as its default.
    """

    def files(options: Any) -> tuple[WeightsFile, ...]:
        uri = getattr(options, option)
        if uri is None:
            return ()
        file = next((file for file in known if file.uri == uri), WeightsFile(uri))
        return (replace(file, sha256=getattr(options, sha256) or file.sha256),)

    return files


@dataclass(frozen=True)
class ModelExport:
    """How the file of a network is made from its authors' code
    (:mod:`mpsfm_core.providers.model_export`).

    ``script``: module of the plugin that does it, run as a program and never imported.
    ``repository``: ``OWNER/NAME`` on GitHub; ``commit``: the one that it was tested with.
    ``license``: of the authors' weights. ``packages``: what their code needs besides
    torch and onnx.
    """

    script: str
    repository: str
    commit: str
    license: str
    packages: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProviderSpec:
    """How a plugin announces one provider, without importing it.

    ``kind``, ``name``: unique together; ``name`` is what a configuration's ``use:`` says.
    ``factory``: ``"package.module:Class"``, imported on first use; a plugin always gives this
    form, a callable is for providers registered in the same process. ``options``: an
    :class:`Options` subclass or ``"package.module:Class"``, None when there are none.
    ``capabilities``: from :data:`CAPABILITIES`. ``requires``: import names that must be
    installed, checked without importing; ``install_hint`` says how to get them.
    ``code_license``, ``weights_license``: SPDX ids or short texts. ``weights``: the files that it
    loads, a function of its options where these can name others; a run finds or fetches them
    before it looks at the first photo. ``accuracy``: what to expect, with its source, in a line.
    ``calibration``: declared uncertainty of a depth, multi-view or normals provider. ``contract``:
    how the contract kit tests it without weights, a function (see
    :class:`mpsfm_core.testing.ContractSetup`) by reference like ``factory``.

    An option of type :class:`~pathlib.Path` names a file or folder that the provider reads: a run
    ends at once where it does not exist.
    """

    kind: Kind
    name: str
    factory: str | Callable[..., object]
    options: type[Options] | str | None = None
    capabilities: frozenset[Capability] = frozenset()
    summary: str = ""
    requires: tuple[str, ...] = ()
    install_hint: str = ""
    code_license: str = "unknown"
    weights_license: str = "none"
    weights: tuple[WeightsFile, ...] | Callable[[Any], tuple[WeightsFile, ...]] = ()
    accuracy: str = ""
    calibration: DepthCalibration | NormalCalibration | None = None
    api_version: int = API_VERSION
    tags: tuple[str, ...] = field(default=())
    """Feature families for matchers and features (``"xfeat"``); a sparse matcher works with
    features that share a tag, or with all when it has none."""
    contract: str | Callable[[Path], object] | None = None


@dataclass(frozen=True)
class ExportFormat:
    """A format of another program that ``mpsfm export`` writes.

    ``description``: one line for people. ``entries``: what it writes into its folder. ``write``:
    called with a :class:`~mpsfm_core.results.exports.source.ExportSource` and an empty folder; a plugin
    gives ``"package.module:function"``, imported when the format is wanted. It raises
    :class:`~mpsfm_core.data.errors.InputError` when the input lacks what the format needs.
    ``turned``: gravity is -z unless the user wants otherwise, for programs that show or render the
    scene. """

    name: str
    description: str
    entries: tuple[str, ...]
    write: str | Callable[[Any, Path], None]
    turned: bool = False


hookspec = pluggy.HookspecMarker("mpsfm")
hookimpl = pluggy.HookimplMarker("mpsfm")


class Hooks:
    """The pluggy hooks. All but :meth:`mpsfm_providers` are optional events."""

    @hookspec
    def mpsfm_providers(self) -> Sequence[ProviderSpec]:  # type: ignore[empty-body]
        """The providers of this plugin."""

    @hookspec
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> Sequence[tuple[str, str]]:  # type: ignore[empty-body]
        """Which of the candidate pairs (image names) to match; the filters' results intersect."""

    @hookspec(firstresult=True)
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Calibration of a prior for these options; None leaves it to the spec's default.

        ``kind`` is depth or normals, or ``wrapper`` for a wrapper around such a provider.
        """

    @hookspec(firstresult=True)
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Executor | None:
        """The executor that ``runtime.executor`` names, connected to its workers; None if it is
        not of this plugin. ``options``: ``runtime.executor_options``.

        Raises :class:`~mpsfm_core.data.errors.ConfigError` when it cannot be had.
        """

    @hookspec
    def mpsfm_exports(self) -> Mapping[str, ModelExport]:  # type: ignore[empty-body]
        """The networks that this plugin can make a file of from their authors' code, by the name
        that ``mpsfm models export`` and ``export:NAME`` know them by."""

    @hookspec
    def mpsfm_notice(self, text: str) -> None:
        """Something that the user should know while the run goes on, in one line: which provider
        is taken and why, what is downloaded."""

    @hookspec
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """A stage of the pipeline begins, with this many steps if known."""

    @hookspec
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Steps done so far."""

    @hookspec
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """A stage ended."""

    @hookspec
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """The mapper accepted an image."""

    @hookspec
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Images or points have moved; ``scene()`` gives a copy of how they are now."""

    @hookspec
    def mpsfm_viewers(self) -> Mapping[str, str]:  # type: ignore[empty-body]
        """The viewers of this plugin: name -> ``"package.module:Class"``, imported when one is
        wanted; see :mod:`mpsfm_core.report.viewing`."""

    @hookspec
    def mpsfm_export_formats(self) -> Sequence[ExportFormat]:  # type: ignore[empty-body]
        """The formats that this plugin writes for ``mpsfm export``."""

    @hookspec
    def mpsfm_image_rejected(self, name: str, reason: Reason, text: str) -> None:
        """The mapper tried an image and rejected it."""
