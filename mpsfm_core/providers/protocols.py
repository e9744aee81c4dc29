"""Interface between MP-SfM and its plugins, which provide networks and other algorithms.

A *provider* predicts depth, normals, features, matches or another quantity from images. A plugin is
an installed Python package with an entry point in the group ``mpsfm.plugins``. The plugin's entry
point names a Python module, which must not import torch, onnxruntime or similar libraries. The
plugin module implements the hook :func:`Hooks.mpsfm_providers`::

    from mpsfm_core import ProviderSpec, hookimpl

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec(kind="depth", name="my-depth", factory="my_package.model:MyDepth")]

MP-SfM calls the provider's factory as ``factory(options, context)`` when the provider is first
used. A wrapper is a provider that modifies the output of another provider ``inner``, and its
factory is called as ``factory(inner, options, context)``. The factory returns an object with the
method that the protocol of the provider's kind requires, such as :meth:`DepthProvider.predict`.

All providers follow the same conventions. A :class:`~mpsfm_core.data.View` is an undistorted image
with ``image`` (H, W, 3) uint8 RGB and a pinhole ``camera`` with intrinsics in pixels. Pixel
coordinates follow COLMAP, where the center of the first pixel is (0.5, 0.5). Points are stored as
(x, y), and depth, normal and mask maps are indexed [row, column]. The camera frame has x right, y
down and z forward. Depth is the z coordinate in the camera frame, in meters if ``metric`` is true.
Uncertainties are variances unless the name ends with ``std``. A depth or normal map covers the
whole image and may have any resolution.

A provider must be deterministic, so that the same input and seed give the same output, bit for bit.
Providers keep no state between calls. A provider may raise any exception, which the run reports
with the names of the provider and the image.
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
"""Version of the plugin interface. A plugin that requires a newer version is unavailable."""

ENTRY_POINT_GROUP = "mpsfm.plugins"
"""Group of the Python entry points that name plugin modules."""

Kind = Literal[
    "depth", "normals", "multiview", "features", "matcher", "retrieval", "mask", "wrapper"
]
KINDS: tuple[Kind, ...] = get_args(Kind)

Capability = Literal[
    # The depth is in meters.
    "metric",
    # The depth or normals have a variance that the network predicts.
    "variance",
    # The depth provider has the method predict_joint().
    "joint-normals",
    # The normals provider requires the depth prior of the image.
    "needs-depth",
    # The matcher requires features and returns matches of features.
    "sparse",
    # The matcher needs no features and returns matches of pixel positions.
    "dense",
    # The matcher also predicts the depth of both images.
    "pair-depth",
    # The wrapper modifies the output of depth providers.
    "wraps-depth",
    # The wrapper modifies the output of normals providers.
    "wraps-normals",
    # The output of the provider depends on the focal length.
    "intrinsics-aware",
    # The depth provider has the method estimate_focal().
    "estimates-focal",
    # The multi-view provider predicts relative camera poses.
    "proposes-poses",
    # The multi-view provider predicts camera intrinsics.
    "proposes-intrinsics",
    # The provider reads its output from files, so the run does not cache the output.
    "uncached",
]
CAPABILITIES: tuple[Capability, ...] = get_args(Capability)


@dataclass(frozen=True)
class ProviderContext:
    """Device, threads, seed and weights access that the factory of a provider receives.

    Examples:
        >>> ProviderContext(resolve_weights=lambda uri, sha256: Path(uri)).device
        'cpu'
    """

    resolve_weights: Callable[[str, str | None], Path]
    """The function ``resolve_weights(uri, sha256)`` returns the local path of a weights file and
    downloads the file if necessary. If the weights file is not available, the function raises
    :class:`~mpsfm_core.data.errors.WeightsError`. The forms of weights URIs are described in
    :mod:`mpsfm_core.providers.weights`."""
    device: str = "cpu"
    """Device on which neural networks run, ``"cpu"`` or ``"cuda"``."""
    threads: int = 1
    """Number of CPU threads that the provider may use."""
    seed: int = 0
    """Seed of the provider's random numbers."""


@runtime_checkable
class DepthProvider(Protocol):
    """Provider that predicts the depth of a single undistorted image."""

    def predict(self, view: View) -> DepthPrior:
        """Predict the z-depth map of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth (h, w) float32 along the optical axis, in meters if ``metric`` is true, else in an
            arbitrary unit. Optional depth variance (h, w) float32 in the squared unit of depth.
            Validity (h, w) bool of the depth values. The depth map covers the image and may have
            any resolution.
        """
        ...


@runtime_checkable
class JointProvider(DepthProvider, Protocol):
    """Depth provider that also predicts normals in one pass (capability ``joint-normals``)."""

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Predict the depth and normals of an image in one network pass.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth prior as in :meth:`predict`, and normal prior as in
            :meth:`NormalsProvider.predict`.
        """
        ...


@runtime_checkable
class FocalEstimator(DepthProvider, Protocol):
    """Depth provider that also estimates the focal length (capability ``estimates-focal``)."""

    def estimate_focal(self, view: View) -> float | None:
        """Estimate the focal length of an image from its pixels.

        Args:
            view: Undistorted image. The focal length estimate must not depend on ``view.camera``.

        Returns:
            Focal length in pixels of the image, or None if the provider cannot estimate it.
        """
        ...


@runtime_checkable
class NormalsProvider(Protocol):
    """Provider that predicts the surface normals of a single undistorted image."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Predict the surface normals of an undistorted image.

        Args:
            view: Undistorted image with its camera.
            depth: Depth prior of the image with variance if the provider has the capability
                ``needs-depth``, else None.

        Returns:
            Unit normals (h, w, 3) float32 in the camera frame that face the camera. Optional
            variance (h, w) float32 of the normal's angle in rad^2. Validity (h, w) bool of the
            normals. The normal map covers the image and may have any resolution.
        """
        ...


@runtime_checkable
class MultiViewProvider(Protocol):
    """Provider that predicts the depth of several images jointly."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Predict the depth of several images in one common unit.

        Args:
            views: One or more undistorted images of one scene, of any sizes.

        Returns:
            One depth prior per image, in the order of ``views`` and in one common unit. Providers
            with the capability ``proposes-poses`` also return camera poses ``cam_from_group`` (n,
            3, 4) float64, with translations in the unit of depth. Providers with the capability
            ``proposes-intrinsics`` also return intrinsics fx, fy, cx, cy (n, 4) float64 in pixels
            of each image.
        """
        ...


@runtime_checkable
class FeatureProvider(Protocol):
    """Provider that detects and describes sparse local features."""

    def extract(self, view: View) -> Features:
        """Detect and describe the local features of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Keypoints (n, 2) float64 in pixels of ``view``, not of a resized image. Descriptors (n,
            d) float32 with the same dimension d for every image. Optional detection scores (n,)
            float32 and optional keypoint scales (n,) float32 in pixels. The standard deviation
            ``std_px`` of keypoint positions in pixels.
        """
        ...


@runtime_checkable
class Matcher(Protocol):
    """Provider that matches two images, either by their features or by their pixels."""

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two undistorted images.

        Args:
            view_a: First undistorted image.
            view_b: Second undistorted image, which may have another size.
            features_a: Features of the first image if the matcher has the capability ``sparse``,
                else None. An image may have no features or many thousands.
            features_b: Features of the second image if the matcher has the capability ``sparse``,
                else None.

        Returns:
            Sparse matches are index pairs (m, 2) int64 of features in the first and second image.
            Dense matches are corresponding points (m, 2) float64 in pixels of each image. Sparse
            and dense matches have scores (m,) float32 in [0, 1], where 1 is best. Matchers with the
            capability ``pair-depth`` also return one depth prior per image.
        """
        ...


@runtime_checkable
class RetrievalProvider(Protocol):
    """Provider of global image descriptors for image retrieval."""

    def describe(self, view: View) -> Float32:
        """Compute the global descriptor of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Global descriptor (d,) float32 with the same dimension d for every image, normally of
            unit length. The dot product of two global descriptors is the similarity of their
            images.
        """
        ...


@runtime_checkable
class MaskProvider(Protocol):
    """Provider of masks, which mark the pixels that the reconstruction may use."""

    def mask(self, view: View) -> Bool:
        """Compute the mask of the pixels in an image that the reconstruction may use.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Mask (H, W) bool in the size of the image, True where the reconstruction may use a
            pixel.
        """
        ...


class Executor(Protocol):
    """Executor that runs feature extraction on workers in other processes or on other machines."""

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Call ``step(item)`` for each item on one of the workers.

        The function ``step`` writes its result to the cache and returns nothing. If a worker is
        lost, the item that it processed runs again on another worker. Closing the generator cancels
        the items that no worker has started.

        Args:
            step: Picklable function that processes one item, such as one image.
            items: Picklable arguments of ``step``, one for each call.

        Yields:
            None after each finished item, in the order of completion.

        Raises:
            Exception: Any exception that ``step`` raises on a worker, unchanged.
        """
        ...

    def close(self) -> None:
        """Release the workers of the executor."""
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
"""Protocol class of each provider kind. A wrapper provider is not listed, because it implements the
protocol of the provider that it wraps."""


CAPABILITY_METHODS: dict[Capability, str] = {
    "joint-normals": "predict_joint",
    "estimates-focal": "estimate_focal",
}
"""Additional method that a provider must have, by the capability that requires the method."""


def require_features(
    purpose: str, features_a: Features | None, features_b: Features | None
) -> tuple[Features, Features]:
    """Return the features of both images, or raise ProviderError if features are missing.

    Args:
        purpose: Beginning of the error message, such as "mutual-nearest matches features".
        features_a: Features of the first image, or None.
        features_b: Features of the second image, or None.

    Returns:
        Features of the first and of the second image.

    Raises:
        ProviderError: The features of the first or second image are None.
    """
    if features_a is None or features_b is None:
        raise ProviderError(f"{purpose}: choose a features provider")
    return features_a, features_b


@dataclass(frozen=True)
class WeightsFile:
    """Weights file of a neural network that a provider loads."""

    uri: str
    """URI or path of the weights file, see :mod:`mpsfm_core.providers.weights`."""
    sha256: str | None = None
    """Expected SHA-256 of the weights file in hex. None records the hash of the first download,
    with which later downloads are compared."""
    license: str = "unknown"
    """License of the weights as SPDX identifier or short text."""
    size: int | None = None
    """Size of the weights file in bytes, which is shown before a download, or None if unknown."""


def weights_from_option(
    option: str, *known: WeightsFile, sha256: str = "sha256"
) -> Callable[[Any], tuple[WeightsFile, ...]]:
    """Return a value for :attr:`ProviderSpec.weights` if an option names the weights file.

    Args:
        option: Name of the provider option that names the weights file by a path or a URI. If the
            option is None, the provider loads no file.
        known: Weights files with known license and size that the option may name, usually the
            option's default.
        sha256: Name of the provider option with the expected SHA-256 of the weights file.

    Returns:
        Function that returns the weights files for given provider options.
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
    """Name of the plugin module that exports the network. The export module runs as a program in
    another process and is never imported."""
    repository: str
    """GitHub repository of the network's source code, as ``OWNER/NAME``."""
    commit: str
    """Git commit of the network's repository with which the export was tested."""
    license: str
    """License of the network's weights, as SPDX identifier or short text."""
    packages: tuple[str, ...] = ()
    """Python packages that the network's source code requires in addition to torch and onnx."""


@dataclass(frozen=True)
class ProviderSpec:
    """Description of a provider, with which a plugin registers it without importing its code.

    A provider option of type :class:`~pathlib.Path` names a file or folder that the provider reads.
    A run stops before the first image if the file or folder does not exist.
    """

    kind: Kind
    """Kind of the provider, such as ``depth``. Two providers of one kind must have different
    names."""
    name: str
    """Name of the provider, which a configuration selects by the key ``use``."""
    factory: str | Callable[..., object]
    """Factory of the provider as ``"package.module:Class"``, which is imported on first use. A
    callable is possible for a provider that :meth:`mpsfm_core.providers.registry.Registry.add`
    registers."""
    options: type[Options] | str | None = None
    """Options class of the provider, which is a subclass of
    :class:`~mpsfm_core.data.options.Options` or its name ``"package.module:Class"``. None declares
    that the provider has no options."""
    capabilities: frozenset[Capability] = frozenset()
    """Capabilities of the provider, from :data:`CAPABILITIES`. If the provider's output lacks a
    declared capability, an error is raised."""
    summary: str = ""
    """One-line description of the provider in the output of ``mpsfm plugins list``."""
    requires: tuple[str, ...] = ()
    """Import names of Python packages that the provider requires. MP-SfM checks that the required
    packages are installed without importing them."""
    install_hint: str = ""
    """Command that installs the Python packages that the provider requires."""
    code_license: str = "unknown"
    """License of the provider's code, as SPDX identifier or short text."""
    weights_license: str = "none"
    """License of the provider's weights, as SPDX identifier or short text."""
    weights: tuple[WeightsFile, ...] | Callable[[Any], tuple[WeightsFile, ...]] = ()
    """Weights files of the provider, or a function that returns the weights files for given
    provider options. A run finds or downloads the weights files before reading the first image."""
    accuracy: str = ""
    """Expected accuracy of the provider and its source, in one line."""
    calibration: DepthCalibration | NormalCalibration | None = None
    """Model that converts the variance of a depth, multi-view or normals provider to a calibrated
    variance. None uses the default uncertainty model."""
    api_version: int = API_VERSION
    """Smallest version of the plugin interface that the plugin supports."""
    tags: tuple[str, ...] = ()
    """Names of the features, such as ``"xfeat"``, that a features provider extracts or a matcher
    accepts. A matcher without tags accepts all features."""
    contract: str | Callable[[Path], object] | None = None
    """Function, or its name ``"package.module:function"``, that prepares the provider for contract
    tests without the real weights. The function returns a
    :class:`~mpsfm_core.testing.ContractSetup`."""


@dataclass(frozen=True)
class ExportFormat:
    """File format of another program, which ``mpsfm export`` writes."""

    name: str
    """Name of the export format on the command line."""
    description: str
    """One-line description of the export format for users."""
    entries: tuple[str, ...]
    """Names of the files and folders that the export writes into the output folder."""
    write: str | Callable[[Any, Path], None]
    """Function that writes the export, or its name ``"package.module:function"``. The arguments of
    the export function are an :class:`~mpsfm_core.results.exports.source.ExportSource` and an empty
    output folder. The export function raises :class:`~mpsfm_core.data.errors.InputError` if the
    reconstruction lacks data that the export format requires."""
    align_gravity: bool = False
    """True rotates the scene by default so that gravity is -z, for programs that show or render the
    scene."""


hookspec = pluggy.HookspecMarker("mpsfm")
hookimpl = pluggy.HookimplMarker("mpsfm")


class Hooks:
    """Hook functions of the library pluggy that a plugin may implement.

    All hooks are optional. If a plugin's hook raises an exception, the run warns the user and does
    not call this hook of the plugin again.
    """

    @hookspec
    def mpsfm_providers(self) -> Sequence[ProviderSpec]:  # type: ignore[empty-body]
        """List the specifications of the providers in this plugin.

        Returns:
            Specifications of the plugin's providers, as a list or tuple.
        """

    @hookspec
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> Sequence[tuple[str, str]]:  # type: ignore[empty-body]
        """Select the image pairs to match from the candidate pairs.

        The run matches an image pair only if this hook of every plugin selects the pair.

        Args:
            pairs: Candidate pairs of image names.

        Returns:
            Selected pairs of image names, a subset of ``pairs``.
        """

    @hookspec(firstresult=True)
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Return the uncertainty model of a provider of this plugin for given provider options.

        Args:
            kind: Kind of the provider, which is ``depth``, ``normals``, ``multiview``, or
                ``wrapper`` for a wrapper around one of these.
            provider: Name of the provider.
            options: Validated options of the provider, None if the provider has no options.

        Returns:
            Uncertainty model, or None to use the uncertainty model in the provider's specification.
        """

    @hookspec(firstresult=True)
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Executor | None:
        """Return the executor that the option ``runtime.executor`` names, connected to its workers.

        Args:
            name: Value of ``runtime.executor``.
            options: Value of ``runtime.executor_options``.

        Returns:
            Executor with that name, or None if this plugin does not provide it.

        Raises:
            ConfigError: The executor options are wrong or the workers cannot be reached.
        """

    @hookspec
    def mpsfm_exports(self) -> Mapping[str, ModelExport]:  # type: ignore[empty-body]
        """List the neural networks that this plugin can export to ONNX from their authors' code.

        Returns:
            Export recipe by the name that ``mpsfm models export NAME`` and ``export:NAME`` use.
        """

    @hookspec
    def mpsfm_notice(self, text: str) -> None:
        """Receive one line of text for the user during a run, such as the name of a provider."""

    @hookspec
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Receive the start of a pipeline stage and its number of steps, or None if unknown."""

    @hookspec
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Receive the number of finished steps of a pipeline stage."""

    @hookspec
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Receive the end of a pipeline stage and its duration."""

    @hookspec
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """Receive the name of a newly registered image and the number of registered images."""

    @hookspec
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Receive a function that copies the reconstruction, whose poses or points have changed."""

    @hookspec
    def mpsfm_viewers(self) -> Mapping[str, str]:  # type: ignore[empty-body]
        """List the live viewers of the reconstruction that this plugin provides.

        Returns:
            Viewer classes ``"package.module:Class"`` by the name of the viewer, see
            :mod:`mpsfm_core.report.viewing`.
        """

    @hookspec
    def mpsfm_export_formats(self) -> Sequence[ExportFormat]:  # type: ignore[empty-body]
        """List the export formats that this plugin adds to ``mpsfm export``."""

    @hookspec
    def mpsfm_image_rejected(self, name: str, reason: Reason, text: str) -> None:
        """Receive the name of an image that the mapper tried to register and rejected.

        Args:
            name: Name of the rejected image.
            reason: Type of the reason for the rejection, see :mod:`mpsfm_core.data.decisions`.
            text: Reason for the rejection in words.
        """
