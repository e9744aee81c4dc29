"""Protocols, hooks and specifications: the interface between MP-SfM and its plugins.

Everything that predicts something from pixels is a *provider*: monocular depth, normals, features,
matches and so on. A plugin is an installed package with an entry point in the group
``mpsfm.plugins``. The entry point names a light module, which must not import torch, onnxruntime or
similar libraries. That module implements the hook :func:`Hooks.mpsfm_providers`::

    from mpsfm_core import ProviderSpec, hookimpl

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec(kind="depth", name="my-depth", factory="my_package.model:MyDepth")]

MP-SfM calls the factory as ``factory(options, context)`` when the provider is first used, and the
factory of a wrapper as ``factory(inner, options, context)``. The factory returns an object with the
method that the protocol of its kind defines below.

Conventions of all protocols:

* A :class:`~mpsfm_core.data.View` is an undistorted image: ``image`` is (H, W, 3) uint8 RGB,
  ``camera`` has the pinhole intrinsics in pixels.
* Pixels follow COLMAP: the center of the first pixel is (0.5, 0.5). Points are (x, y), maps are
  indexed [row, column].
* The camera frame has x right, y down and z forward. Depth is z, in meters if ``metric``.
* Uncertainties are variances unless the name ends with ``std``.
* A depth or normal map may have any grid that covers the whole view.
* The same input and seed give the same output, bit for bit. Providers keep no state between calls.
* A provider may raise any exception. The run reports it with the names of provider and image.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import pluggy
from pydantic import BaseModel

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Features,
    Float32,
    MultiViewPrior,
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
"""Version of this interface. A plugin that requires a newer one is listed as unavailable."""

ENTRY_POINT_GROUP = "mpsfm.plugins"
"""Group of the entry points that name plugin modules."""

Kind = Literal[
    "depth", "normals", "multiview", "features", "matcher", "retrieval", "mask", "wrapper"
]
KINDS: tuple[Kind, ...] = get_args(Kind)

Capability = Literal[
    "metric",  # depth is in meters
    "variance",  # depth or normals have a variance from the network
    "joint-normals",  # depth provider with predict_joint()
    "needs-depth",  # normals provider that requires the depth prior of the view
    "sparse",  # matcher that requires features and returns sparse matches
    "dense",  # matcher that needs no features and returns dense matches
    "pair-depth",  # matcher that also predicts the depth of both views
    "wraps-depth",  # wrapper for depth providers
    "wraps-normals",  # wrapper for normals providers
    "intrinsics-aware",  # the output depends on the focal length
    "estimates-focal",  # depth provider with estimate_focal()
    "proposes-poses",  # multi-view provider that predicts relative poses
    "proposes-intrinsics",  # multi-view provider that predicts intrinsics
    "uncached",  # reads its output from files: the run neither caches nor reuses it
]
CAPABILITIES: tuple[Capability, ...] = get_args(Capability)


@dataclass(frozen=True)
class ProviderContext:
    """Resources of the run that a provider's factory receives."""

    resolve_weights: Callable[[str, str | None], Path]
    """``resolve_weights(uri, sha256)`` returns the local path of a weights file and downloads the
    file if necessary. It raises :class:`~mpsfm_core.data.errors.WeightsError`. URIs are described
    in :mod:`mpsfm_core.providers.weights`."""
    device: str = "cpu"
    """``"cpu"`` or ``"cuda"``, already resolved."""
    threads: int = 1
    """Number of threads that the provider may use."""
    seed: int = 0
    """Seed of every random choice."""


@runtime_checkable
class DepthProvider(Protocol):
    """Monocular depth network."""

    def predict(self, view: View) -> DepthPrior:
        """Predict the z-depth of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth (h, w) float32 along the optical axis, in meters if ``metric``, else in a unit
            of its own; optional variance (h, w) float32 in the squared unit; validity (h, w) bool.
            The grid covers the view and may have any size.
        """
        ...


@runtime_checkable
class JointProvider(DepthProvider, Protocol):
    """Depth network that also predicts normals in the same pass (``joint-normals``)."""

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Predict depth and normals of a view in one pass.

        Args:
            view: Undistorted image with its camera.

        Returns:
            The depth that :meth:`predict` returns, and normals as
            :meth:`NormalsProvider.predict` returns them.
        """
        ...


@runtime_checkable
class FocalEstimator(DepthProvider, Protocol):
    """Depth network that also estimates the focal length of a view (``estimates-focal``)."""

    def estimate_focal(self, view: View) -> float | None:
        """Estimate the focal length of a view from its pixels.

        Args:
            view: Undistorted image. The estimate must not depend on ``view.camera``.

        Returns:
            Focal length in pixels of the view, or None if no estimate is possible.
        """
        ...


@runtime_checkable
class NormalsProvider(Protocol):
    """Surface normal network."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Predict the surface normals of a view.

        Args:
            view: Undistorted image with its camera.
            depth: Depth prior of the view with its variance, if the specification declares
                ``needs-depth``; else None.

        Returns:
            Unit normals (h, w, 3) float32 in the camera frame that face the camera; optional
            variance (h, w) float32 of the angle in rad^2; validity (h, w) bool. The grid covers
            the view and may have any size.
        """
        ...


@runtime_checkable
class MultiViewProvider(Protocol):
    """Network that predicts the depth of several views jointly."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Predict the depth of a group of views in one common unit.

        Args:
            views: One or more views of one scene, of any sizes.

        Returns:
            One depth prior per view, in the order of ``views`` and in one unit. With
            ``proposes-poses`` also ``cam_from_group`` (n, 3, 4) float64, translations in the unit
            of depth. With ``proposes-intrinsics`` also fx, fy, cx, cy (n, 4) float64 in pixels of
            each view.
        """
        ...


@runtime_checkable
class FeatureProvider(Protocol):
    """Detector and descriptor of sparse local features."""

    def extract(self, view: View) -> Features:
        """Detect and describe the features of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Keypoints (n, 2) float64 in pixels of the view, not of a resized image; descriptors
            (n, d) float32 with the same d for every view; optional scores and scales (n,)
            float32; ``std_px``, the standard deviation of a keypoint in pixels.
        """
        ...


@runtime_checkable
class Matcher(Protocol):
    """Matcher of two views, with features (``sparse``) or without (``dense``)."""

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two views.

        Args:
            view_a: First view.
            view_b: Second view; its size may differ.
            features_a: Features of the first view if the specification declares ``sparse``, else
                None. There may be none or many thousands.
            features_b: Features of the second view, likewise.

        Returns:
            Sparse matches: rows of both feature sets (m, 2) int64. Dense matches: points (m, 2)
            float64 in pixels of each view. Both have scores (m,) float32 in [0, 1], higher is
            better. With ``pair-depth`` also one depth prior per view.
        """
        ...


@runtime_checkable
class RetrievalProvider(Protocol):
    """Global image descriptor for image retrieval."""

    def describe(self, view: View) -> Float32:
        """Describe a view by one vector.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Descriptor (d,) float32 with the same d for every view, normally of unit length. The
            dot product of two descriptors is the similarity of their views.
        """
        ...


@runtime_checkable
class MaskProvider(Protocol):
    """Segmentation of the pixels that the reconstruction may use."""

    def mask(self, view: View) -> Bool:
        """Segment the usable pixels of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Mask (H, W) bool on the pixel grid of the view, True where a pixel may be used.
        """
        ...


class Executor(Protocol):
    """Executor that runs steps of the extraction on workers in other processes or machines."""

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Run ``step(item)`` for all items.

        A step writes its result to the cache. If a worker is lost, its step runs again on another
        worker. Closing the generator cancels the items that have not started.

        Args:
            step: Function that can be pickled.
            items: Arguments that can be pickled.

        Yields:
            None for each finished item, in any order.

        Raises:
            Exception: The exception that a step raised, unchanged.
        """
        ...

    def close(self) -> None:
        """Release the workers."""
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
"""Protocol of each kind. A wrapper implements the protocol of the provider that it wraps."""


CAPABILITY_METHODS: dict[Capability, str] = {
    "joint-normals": "predict_joint",
    "estimates-focal": "estimate_focal",
}
"""Additional method that a capability requires."""


def require_features(
    purpose: str, features_a: Features | None, features_b: Features | None
) -> tuple[Features, Features]:
    """Return the features of both views, for a matcher that cannot work without them.

    Args:
        purpose: Beginning of the error message, such as "mutual-nearest matches features".
        features_a: Features of the first view, or None.
        features_b: Features of the second view, or None.

    Returns:
        Both feature sets.

    Raises:
        ProviderError: One of them is None.
    """
    if features_a is None or features_b is None:
        raise ProviderError(f"{purpose}: choose a features provider")
    return features_a, features_b


@dataclass(frozen=True)
class WeightsFile:
    """Weights file that a provider loads."""

    uri: str
    """Location, see :mod:`mpsfm_core.providers.weights`."""
    sha256: str | None = None
    """Hash in hex. With None the hash of the first download is recorded and compared later."""
    license: str = "unknown"
    """SPDX identifier or a short text."""
    size: int | None = None
    """Size in bytes, shown before a download; None if unknown."""


def weights_from_option(
    option: str, *known: WeightsFile, sha256: str = "sha256"
) -> Callable[[Any], tuple[WeightsFile, ...]]:
    """Declare that an option names the weights file, for :attr:`ProviderSpec.weights`.

    Args:
        option: Name of the option. Its value is a path, a URI, or None for no file.
        known: Files that the option may name, with license and size; usually its default.
        sha256: Name of the option with the expected hash.

    Returns:
        Function from the provider's options to its weights files.
    """

    def list_files(options: Any) -> tuple[WeightsFile, ...]:
        uri = getattr(options, option)
        if uri is None:
            return ()
        file = next((file for file in known if file.uri == uri), WeightsFile(uri))
        return (replace(file, sha256=getattr(options, sha256) or file.sha256),)

    return list_files


@dataclass(frozen=True)
class ModelExport:
    """Recipe for the ONNX file of a network, see :mod:`mpsfm_core.providers.model_export`."""

    script: str
    """Module of the plugin that exports the network. It runs as a program, never as an import."""
    repository: str
    """``OWNER/NAME`` of the authors' code on GitHub."""
    commit: str
    """Commit with which the script was tested."""
    license: str
    """License of the authors' weights."""
    packages: tuple[str, ...] = ()
    """Packages that the authors' code needs in addition to torch and onnx."""


@dataclass(frozen=True)
class ProviderSpec:
    """Specification of one provider, which a plugin registers without importing the provider.

    An option of type :class:`~pathlib.Path` names a file or folder that the provider reads. A run
    stops before the first image if that path does not exist.
    """

    kind: Kind
    """Kind of provider; kind and name are unique together."""
    name: str
    """Name that a configuration gives as ``use:``."""
    factory: str | Callable[..., object]
    """``"package.module:Class"``, imported on first use. Only providers that are registered in the
    same process may give a callable."""
    options: type[Options] | str | None = None
    """Subclass of :class:`~mpsfm_core.data.options.Options`, ``"package.module:Class"``, or None
    if there are no options."""
    capabilities: frozenset[Capability] = frozenset()
    """Capabilities from :data:`CAPABILITIES`; the validator checks what they promise."""
    summary: str = ""
    """One line for ``mpsfm plugins list``."""
    requires: tuple[str, ...] = ()
    """Import names that must be installed. They are looked up without an import."""
    install_hint: str = ""
    """Command that installs what ``requires`` names."""
    code_license: str = "unknown"
    """SPDX identifier or short text for the code."""
    weights_license: str = "none"
    """SPDX identifier or short text for the weights."""
    weights: tuple[WeightsFile, ...] | Callable[[Any], tuple[WeightsFile, ...]] = ()
    """Weights files, or a function from the options to them. A run finds or downloads the files
    before it reads the first image."""
    accuracy: str = ""
    """Expected accuracy and its source, in one line."""
    calibration: DepthCalibration | NormalCalibration | None = None
    """Uncertainty model of a depth, multi-view or normals provider; None uses the defaults."""
    api_version: int = API_VERSION
    """Version of this interface that the plugin requires."""
    tags: tuple[str, ...] = ()
    """Feature families (``"xfeat"``) of features providers and matchers. A sparse matcher works
    with features that share a tag, or with all features if it has no tag."""
    contract: str | Callable[[Path], object] | None = None
    """Function, given like ``factory``, that returns the
    :class:`~mpsfm_core.testing.ContractSetup` for tests without weights."""


@dataclass(frozen=True)
class ExportFormat:
    """File format of another program that ``mpsfm export`` writes."""

    name: str
    """Name on the command line."""
    description: str
    """One line for users."""
    entries: tuple[str, ...]
    """Files and folders that the format writes into its folder."""
    write: str | Callable[[Any, Path], None]
    """Function of an :class:`~mpsfm_core.results.exports.source.ExportSource` and an empty folder,
    or ``"package.module:function"``, imported on use. It raises
    :class:`~mpsfm_core.data.errors.InputError` if the input lacks required data."""
    align_gravity: bool = False
    """True rotates the scene so that gravity is -z unless the user declines; for programs that show
    or render it."""


hookspec = pluggy.HookspecMarker("mpsfm")
hookimpl = pluggy.HookimplMarker("mpsfm")


class Hooks:
    """Hooks that a plugin may implement. All except :meth:`mpsfm_providers` are optional.

    A hook that raises is skipped for the rest of the run, with a warning that names its plugin.
    """

    @hookspec
    def mpsfm_providers(self) -> Sequence[ProviderSpec]:  # type: ignore[empty-body]
        """List the providers of this plugin.

        Returns:
            List or tuple of specifications.
        """

    @hookspec
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> Sequence[tuple[str, str]]:  # type: ignore[empty-body]
        """Select the candidate pairs to match. The results of several filters are intersected.

        Args:
            pairs: Pairs of image names.

        Returns:
            Pairs of image names, a subset of ``pairs``.
        """

    @hookspec(firstresult=True)
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Return the uncertainty model of a provider with the given options.

        Args:
            kind: ``depth``, ``normals`` or ``multiview``, or ``wrapper`` for a wrapper around such
                a provider.
            provider: Name of the provider.
            options: Its validated options, None if it has none.

        Returns:
            The calibration, or None to use the one of the specification.
        """

    @hookspec(firstresult=True)
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Executor | None:
        """Return the executor that ``runtime.executor`` names, connected to its workers.

        Args:
            name: Value of ``runtime.executor``.
            options: Value of ``runtime.executor_options``.

        Returns:
            The executor, or None if this plugin does not provide it.

        Raises:
            ConfigError: The options are wrong or the workers cannot be reached.
        """

    @hookspec
    def mpsfm_exports(self) -> Mapping[str, ModelExport]:  # type: ignore[empty-body]
        """List the networks that this plugin can export from their authors' code.

        Returns:
            Recipe by name; the name appears in ``mpsfm models export NAME`` and ``export:NAME``.
        """

    @hookspec
    def mpsfm_notice(self, text: str) -> None:
        """Report one line to the user during a run, such as the chosen provider or a download."""

    @hookspec
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Report that a pipeline stage starts; ``total`` is its number of steps, if known."""

    @hookspec
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Report the number of finished steps of a stage."""

    @hookspec
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Report that a stage has finished and how long it took."""

    @hookspec
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """Report that the mapper registered an image; both counts are numbers of images."""

    @hookspec
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Report that poses or points have changed; ``scene()`` returns a copy of the state."""

    @hookspec
    def mpsfm_viewers(self) -> Mapping[str, str]:  # type: ignore[empty-body]
        """List the viewers of this plugin.

        Returns:
            ``"package.module:Class"`` by name, imported on use; see
            :mod:`mpsfm_core.report.viewing`.
        """

    @hookspec
    def mpsfm_export_formats(self) -> Sequence[ExportFormat]:  # type: ignore[empty-body]
        """List the formats that this plugin adds to ``mpsfm export``."""

    @hookspec
    def mpsfm_image_rejected(self, name: str, reason: Reason, text: str) -> None:
        """Report that the mapper tried to register an image and rejected it.

        Args:
            name: Name of the image.
            reason: Typed reason, see :mod:`mpsfm_core.data.decisions`.
            text: The reason in words.
        """
