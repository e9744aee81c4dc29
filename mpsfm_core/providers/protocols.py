"""Interface between MP-SfM and plugins: specifications of providers, and hooks.

The protocol of each provider kind is in :mod:`mpsfm_core.providers.kinds`.

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
method that the protocol of the provider's kind requires, such as
``DepthProvider.predict``.

All providers follow the same conventions. A :class:`~mpsfm_core.data.View` is an undistorted image
with ``image`` (H, W, 3) uint8 RGB and a pinhole ``camera`` with intrinsics in pixels. Pixel
coordinates follow COLMAP, where the center of the first pixel is (0.5, 0.5). Points are stored as
(x, y), and depth, normal and mask maps are indexed [row, column]. The camera frame has x right, y
down and z forward. Depth is the z coordinate in the camera frame, in meters if ``metric`` is true.
Uncertainties are variances unless the name ends with ``std``. A depth or normal map covers the
whole image and may have any resolution.

A provider must be deterministic, so that the same input and seed give the same output, bit for bit.
The output depends only on the arguments of the call, with all fields of a view, so a cache is
allowed if no result depends on it. The arrays of the arguments are read-only, and a provider does
not modify them by other means, such as ``torch.from_numpy``. Each thread of a run has its own
instance, but instances share the modules and global variables of the plugin. A provider may raise
any exception, which the run reports with the names of the provider and the image.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import pluggy
from pydantic import BaseModel

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.options import Options
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

API_VERSION = 1
"""Version of the plugin interface. A plugin that requires a newer version is unavailable."""

ENTRY_POINT_GROUP = "mpsfm.plugins"
"""Group of the Python entry points that name plugin modules."""

Kind = str
"""Name of a provider kind, such as ``depth``. The package :mod:`mpsfm_core.providers.kinds` defines
the kinds."""

Capability = str
"""Name of a capability that a provider declares. The description of the provider's kind lists the
capabilities, see :class:`~mpsfm_core.providers.provider_kind.ProviderKind`."""


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


class Executor(Protocol):
    """Executor that runs extraction, mapping and stereo in other processes or on other machines."""

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Call ``step(item)`` for each item on one of the workers.

        The function ``step`` writes its result to the cache and returns nothing. If a worker
        process ends unexpectedly, another worker processes its item again. Closing the returned
        generator cancels all items that no worker has started.

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
    """Capabilities of the provider, from
    :data:`mpsfm_core.providers.kinds.CAPABILITIES`. If the provider's output lacks a
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
    """Expected accuracy of the provider and the source of the figures, in one line."""
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
    def mpsfm_filter_pairs(
        self, pairs: Sequence[tuple[str, str]]
    ) -> Sequence[tuple[str, str]] | None:
        """Select the image pairs to match from the candidate pairs.

        The run matches an image pair only if the hook ``mpsfm_filter_pairs`` of every plugin
        selects the pair.

        Args:
            pairs: Candidate pairs of image names.

        Returns:
            Selected pairs of image names, a subset of ``pairs``, or None for all. The order of the
            pairs, and of the two names of a pair, has no meaning.
        """

    @hookspec(firstresult=True)
    def mpsfm_calibration(
        self, kind: str, provider: str, options: BaseModel | None
    ) -> DepthCalibration | NormalCalibration | None:
        """Return the uncertainty model of a provider of this plugin for given provider options.

        Args:
            kind: Kind of the provider, which is ``depth``, ``normals``, ``multiview`` or
                ``wrapper``.
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
            Executor with the given name, or None if the plugin has no such executor.

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
