"""Protocols, hooks and specifications: the interface between MP-SfM and its plugins.

A *provider* predicts something from pixels: monocular depth, normals, features, matches and so on.
A plugin is an installed package with an entry point in the group ``mpsfm.plugins``. The entry point
names a Python module, which must not import torch, onnxruntime or similar libraries. The entry
point's module implements the hook :func:`Hooks.mpsfm_providers`::

    from mpsfm_core import ProviderSpec, hookimpl

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec(kind="depth", name="my-depth", factory="my_package.model:MyDepth")]

MP-SfM calls the factory as ``factory(options, context)`` when the provider is first used, and the
factory of a wrapper as ``factory(inner, options, context)``. The factory returns an object with the
method that the protocol of the provider's kind defines below.

Conventions of all provider protocols:

* A :class:`~mpsfm_core.data.View` is an undistorted image: ``image`` is (H, W, 3) uint8 RGB,
  ``camera`` has the pinhole intrinsics in pixels.
* Pixels follow COLMAP: the center of the first pixel is (0.5, 0.5). Points are (x, y), maps are
  indexed [row, column].
* The camera frame has x right, y down and z forward. Depth is z, in meters if ``metric``.
* Uncertainties are variances unless the name ends with ``std``.
* A depth or normal map may have any grid that covers the whole view.
* The same input and seed give the same output, bit for bit. Providers keep no state between calls.
* A provider may raise any exception. The run reports the exception with the names of provider and
  image.
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
"""Version of the plugin interface. A plugin that requires a newer interface version is listed as
unavailable."""

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
    """Resources of a run that the factory of a provider receives."""

    resolve_weights: Callable[[str, str | None], Path]
    """``resolve_weights(uri, sha256)`` returns the local path of a weights file and downloads the
    file if necessary. The function raises :class:`~mpsfm_core.data.errors.WeightsError`. URIs are
    described in :mod:`mpsfm_core.providers.weights`."""
    device: str = "cpu"
    """Device of the networks, ``"cpu"`` or ``"cuda"``."""
    threads: int = 1
    """Number of threads that the provider may use."""
    seed: int = 0
    """Seed of all random choices of the provider."""


@runtime_checkable
class DepthProvider(Protocol):
    """Provider that predicts the depth of a single view."""

    def predict(self, view: View) -> DepthPrior:
        """Predict the z-depth map of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth (h, w) float32 along the optical axis, in meters if ``metric``, else in a unit of
            its own. Optional variance (h, w) float32 in the squared unit of depth. Validity (h, w)
            bool of the depth. The map covers the view and may have any resolution.
        """
        ...


@runtime_checkable
class JointProvider(DepthProvider, Protocol):
    """Depth provider that also predicts normals in the same pass (``joint-normals``)."""

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Predict the depth and normals of a view in one network pass.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth as :meth:`predict` returns it, and normals as :meth:`NormalsProvider.predict`
            returns them.
        """
        ...


@runtime_checkable
class FocalEstimator(DepthProvider, Protocol):
    """Depth provider that also estimates the focal length of a view (``estimates-focal``)."""

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
    """Provider that predicts the surface normals of a single view."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Predict the surface normals of a view.

        Args:
            view: Undistorted image with its camera.
            depth: Depth prior of the view with its variance if the specification declares
                ``needs-depth``, else None.

        Returns:
            Unit normals (h, w, 3) float32 in the camera frame that face the camera. Optional
            variance (h, w) float32 of the angle in rad^2. Validity (h, w) bool of the normals. The
            map covers the view and may have any resolution.
        """
        ...


@runtime_checkable
class MultiViewProvider(Protocol):
    """Provider that predicts the depth of several views jointly."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Predict the depth of a group of views in one common unit.

        Args:
            views: One or more views of one scene, of any image sizes.

        Returns:
            One depth prior per view, in the order of ``views`` and in one unit. With the capability
            ``proposes-poses`` also ``cam_from_group`` (n, 3, 4) float64, with translations in the
            unit of depth. With the capability ``proposes-intrinsics`` also fx, fy, cx, cy (n, 4)
            float64 in pixels of each view.
        """
        ...


@runtime_checkable
class FeatureProvider(Protocol):
    """Provider that detects and describes sparse local features."""

    def extract(self, view: View) -> Features:
        """Detect and describe the local features of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Keypoints (n, 2) float64 in pixels of the view, not of a resized image. Descriptors (n,
            d) float32 with the same d for every view. Optional detection scores and scales in
            pixels, (n,) float32. ``std_px`` is the standard deviation of a keypoint in pixels.
        """
        ...


@runtime_checkable
class Matcher(Protocol):
    """Provider that matches two views, with given features (``sparse``) or without (``dense``)."""

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
            view_b: Second view, which may have another image size.
            features_a: Features of the first view if the specification declares ``sparse``, else
                None. A view may have no features or many thousands.
            features_b: Features of the second view if the specification declares ``sparse``, else
                None.

        Returns:
            Sparse matches are rows of both feature sets (m, 2) int64. Dense matches are points (m,
            2) float64 in pixels of each view. Sparse and dense matches have scores (m,) float32 in
            [0, 1], higher is better. With the capability ``pair-depth`` also one depth prior per
            view.
        """
        ...


@runtime_checkable
class RetrievalProvider(Protocol):
    """Provider of global image descriptors for image retrieval."""

    def describe(self, view: View) -> Float32:
        """Compute the global descriptor of a view.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Descriptor (d,) float32 with the same d for every view, normally of unit length. The
            dot product of two descriptors is the similarity of their views.
        """
        ...


@runtime_checkable
class MaskProvider(Protocol):
    """Provider that segments the pixels that the reconstruction may use."""

    def mask(self, view: View) -> Bool:
        """Segment the pixels of a view that the reconstruction may use.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Mask (H, W) bool on the pixel grid of the view, True where a pixel may be used.
        """
        ...


class Executor(Protocol):
    """Executor of feature extraction steps on workers in other processes or on other machines."""

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Run ``step(item)`` for all items on the workers.

        A step writes its result to the cache and returns nothing. If a worker is lost, its step
        runs again on another worker. Closing the generator cancels the items whose step has not
        started.

        Args:
            step: Picklable function that processes one item.
            items: Picklable arguments of ``step``.

        Yields:
            None for each finished item, in the order of completion.

        Raises:
            Exception: Any exception that a step raises on a worker, unchanged.
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
"""Protocol class of each provider kind. A wrapper has no protocol of its own and implements the
protocol of the wrapped provider."""


CAPABILITY_METHODS: dict[Capability, str] = {
    "joint-normals": "predict_joint",
    "estimates-focal": "estimate_focal",
}
"""Additional method that a provider with the capability must have."""


def require_features(
    purpose: str, features_a: Features | None, features_b: Features | None
) -> tuple[Features, Features]:
    """Return the features of both views, or raise an error for a matcher that requires them.

    Args:
        purpose: Beginning of the error message, such as "mutual-nearest matches features".
        features_a: Features of the first view, or None.
        features_b: Features of the second view, or None.

    Returns:
        Both feature sets.

    Raises:
        ProviderError: One of the two feature sets is None.
    """
    if features_a is None or features_b is None:
        raise ProviderError(f"{purpose}: choose a features provider")
    return features_a, features_b


@dataclass(frozen=True)
class WeightsFile:
    """Weights file of a network that a provider loads."""

    uri: str
    """Location of the file, see :mod:`mpsfm_core.providers.weights`."""
    sha256: str | None = None
    """Expected SHA-256 in hex. With None the hash of the first download is recorded
    and compared later."""
    license: str = "unknown"
    """License of the weights as SPDX identifier or short text."""
    size: int | None = None
    """Size of the file in bytes, shown before a download; None if unknown."""


def weights_from_option(
    option: str, *known: WeightsFile, sha256: str = "sha256"
) -> Callable[[Any], tuple[WeightsFile, ...]]:
    """Declare, for :attr:`ProviderSpec.weights`, the option that names the weights file.

    Args:
        option: Name of the option that names the weights file. The option's value is a path, a URI,
            or None for no file.
        known: Files that the option may name, with license and size; usually the option's default.
        sha256: Name of the option with the expected SHA-256.

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
    """Recipe that exports a network to ONNX, see :mod:`mpsfm_core.providers.model_export`."""

    script: str
    """Module of the plugin that exports the network. The export module runs as a program and is
    never imported."""
    repository: str
    """GitHub repository of the authors' code, ``OWNER/NAME``."""
    commit: str
    """Git commit of the authors' code with which the export was tested."""
    license: str
    """License of the authors' weights as SPDX identifier or short text."""
    packages: tuple[str, ...] = ()
    """Python packages that the authors' code needs in addition to torch and onnx."""


@dataclass(frozen=True)
class ProviderSpec:
    """Specification with which a plugin registers a provider without importing its code.

    A provider option of type :class:`~pathlib.Path` names a file or folder that the provider reads.
    A run stops before the first image if such a path does not exist.
    """

    kind: Kind
    """Kind of provider; the pair of kind and name is unique."""
    name: str
    """Name of the provider, which a configuration gives as ``use:``."""
    factory: str | Callable[..., object]
    """Factory of the provider as ``"package.module:Class"``, imported on first use. Only providers
    that are registered in the same process may give a callable as factory."""
    options: type[Options] | str | None = None
    """Options class of the provider: a subclass of :class:`~mpsfm_core.data.options.Options`,
    ``"package.module:Class"``, or None if there are no options."""
    capabilities: frozenset[Capability] = frozenset()
    """Capabilities of the provider, from :data:`CAPABILITIES`; the validator checks them."""
    summary: str = ""
    """One-line description of the provider for ``mpsfm plugins list``."""
    requires: tuple[str, ...] = ()
    """Import names of Python packages that the provider requires. MP-SfM looks up the required
    packages without importing them."""
    install_hint: str = ""
    """Command that installs the packages in ``requires``."""
    code_license: str = "unknown"
    """License of the provider's code as SPDX identifier or short text."""
    weights_license: str = "none"
    """License of the provider's weights as SPDX identifier or short text."""
    weights: tuple[WeightsFile, ...] | Callable[[Any], tuple[WeightsFile, ...]] = ()
    """Weights files of the provider, or a function from its options to the files. A run finds or
    downloads the weights files before reading the first image."""
    accuracy: str = ""
    """Expected accuracy of the provider and its source, in one line."""
    calibration: DepthCalibration | NormalCalibration | None = None
    """Uncertainty model of a depth, multi-view or normals provider; None uses the default
    uncertainty model."""
    api_version: int = API_VERSION
    """Version of the plugin interface that the plugin requires."""
    tags: tuple[str, ...] = ()
    """Feature families (such as ``"xfeat"``) of features providers and matchers. A sparse matcher
    works with features that share a family, or with all features if the matcher has no family."""
    contract: str | Callable[[Path], object] | None = None
    """Function or ``"package.module:function"`` that returns the
    :class:`~mpsfm_core.testing.ContractSetup` for contract tests without the real weights."""


@dataclass(frozen=True)
class ExportFormat:
    """Export format for another program, which ``mpsfm export`` writes."""

    name: str
    """Name of the format on the command line."""
    description: str
    """One-line description of the export format for users."""
    entries: tuple[str, ...]
    """Files and folders that the exporter writes into the output folder."""
    write: str | Callable[[Any, Path], None]
    """Exporter: a function of an :class:`~mpsfm_core.results.exports.source.ExportSource` and an
    empty output folder. It is given as a callable or as ``"package.module:function"``, imported on
    use. The exporter raises :class:`~mpsfm_core.data.errors.InputError` if the input lacks required
    data."""
    align_gravity: bool = False
    """True rotates the scene so that gravity is -z unless the user declines, for programs that show
    or render the scene."""


hookspec = pluggy.HookspecMarker("mpsfm")
hookimpl = pluggy.HookimplMarker("mpsfm")


class Hooks:
    """Hooks that a plugin may implement, as in pluggy.

    Every hook except :meth:`mpsfm_providers` is optional. If a hook raises, the run skips this hook
    of the plugin from then on and warns the user.
    """

    @hookspec
    def mpsfm_providers(self) -> Sequence[ProviderSpec]:  # type: ignore[empty-body]
        """List the provider specifications of this plugin.

        Returns:
            List or tuple of provider specifications.
        """

    @hookspec
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> Sequence[tuple[str, str]]:  # type: ignore[empty-body]
        """Select the candidate image pairs to match.

        The run matches the pairs that the filters of all plugins select.

        Args:
            pairs: Candidate pairs of image names.

        Returns:
            Selected pairs of image names, a subset of ``pairs``.
        """

    @hookspec(firstresult=True)
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Return the uncertainty model of a provider of this plugin for the given options.

        Args:
            kind: Kind of the provider: ``depth``, ``normals``, ``multiview``, or ``wrapper`` for a
                wrapper around such a provider.
            provider: Name of the provider.
            options: Validated options of the provider, None if the provider has no options.

        Returns:
            The uncertainty model, or None to use the one of the specification.
        """

    @hookspec(firstresult=True)
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Executor | None:
        """Return the executor that the option ``runtime.executor`` names, connected to its workers.

        Args:
            name: Value of ``runtime.executor``.
            options: Value of ``runtime.executor_options``.

        Returns:
            The executor, or None if this plugin has no executor with that name.

        Raises:
            ConfigError: The executor options are wrong or the workers cannot be reached.
        """

    @hookspec
    def mpsfm_exports(self) -> Mapping[str, ModelExport]:  # type: ignore[empty-body]
        """List the networks that this plugin can export from their authors' code.

        Returns:
            Recipe by name; the name appears in ``mpsfm models export NAME`` and ``export:NAME``.
        """

    @hookspec
    def mpsfm_notice(self, text: str) -> None:
        """Receive one line for the user during a run, such as the chosen provider or a download."""

    @hookspec
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Receive the start of a pipeline stage and its number of steps ``total``, if known."""

    @hookspec
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Receive the number of finished steps of a pipeline stage."""

    @hookspec
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Receive the end of a pipeline stage and its duration."""

    @hookspec
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """Receive the registration of an image by the mapper; both counts are numbers of images."""

    @hookspec
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Receive changes of poses or points; ``scene()`` copies the current reconstruction."""

    @hookspec
    def mpsfm_viewers(self) -> Mapping[str, str]:  # type: ignore[empty-body]
        """List the live viewers of this plugin.

        Returns:
            Viewer classes ``"package.module:Class"`` by name, imported on use; see
            :mod:`mpsfm_core.report.viewing`.
        """

    @hookspec
    def mpsfm_export_formats(self) -> Sequence[ExportFormat]:  # type: ignore[empty-body]
        """List the export formats that this plugin adds to ``mpsfm export``."""

    @hookspec
    def mpsfm_image_rejected(self, name: str, reason: Reason, text: str) -> None:
        """Receive an image that the mapper tried to register and rejected.

        Args:
            name: Name of the rejected image.
            reason: Type of the reason, see :mod:`mpsfm_core.data.decisions`.
            text: Reason of the rejection in words.
        """
