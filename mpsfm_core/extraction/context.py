"""State shared by extraction stages, with masked views, providers, cache and failures."""

from __future__ import annotations

import logging
import shutil
import weakref
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, TypeVar, cast

import numpy as np

from mpsfm_core.config import Config
from mpsfm_core.data import Bool, UInt8, View
from mpsfm_core.data.cameras import defer_decoding
from mpsfm_core.data.errors import MpsfmError, ProviderOutputError, ProviderRunError
from mpsfm_core.extraction.active_provider import ActiveProvider, worker_count
from mpsfm_core.extraction.cache import Cache, content_key, digest
from mpsfm_core.extraction.empty_results import EMPTY_RESULTS
from mpsfm_core.extraction.events import ExtractionEvents
from mpsfm_core.extraction.parallel import run_stage
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.providers import Kind
from mpsfm_core.providers.kinds.mask import run_mask
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

_log = logging.getLogger(__name__)

RUNS = "run"
"""Cache subfolder in which the workers of one run share provider failures."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class ExtractionContext:
    """Runs providers on masked views, and caches their results."""

    def __init__(
        self, images: ImageSet, config: Config, registry: Registry, events: ExtractionEvents
    ) -> None:
        self.images = images
        self.config = config
        self.registry = registry
        self.cache = Cache(config.runtime.cache_dir)
        self.providers: list[ActiveProvider] = []
        self.failures: dict[int, str] = {}
        """Error message of each skipped image, by image index."""
        self.pair_failures: dict[tuple[int, ...], str] = {}
        """Error message of each skipped pair or group of images, by image indices."""
        self.originals: dict[int, int] | None = None
        """Index of the original image by index of the duplicate, or None before duplicates are
        searched."""
        self._events = events
        self.run_remotely: Callable[[str, Sequence[Any]], Generator[None, None, None]] | None = None
        """Function that runs an extraction stage on remote workers, or None without a remote
        executor."""
        self.shared_run = ""
        """Identifier of the run, under which remote workers share provider failures."""
        self._mask_providers: list[ActiveProvider] = []
        self._masks: dict[int, tuple[UInt8, str]] = {}

    def provider(self, kind: Kind, backend: ProviderConfig) -> ActiveProvider:
        """Create the provider of a configuration block for this run."""
        provider = ActiveProvider(kind, backend, self.registry, self.config.runtime)
        self.providers.append(provider)
        return provider

    def each(
        self,
        stage: str,
        items: Sequence[Item],
        work: Callable[[Item], Result],
        *providers: ActiveProvider,
        local: bool = False,
        remote_items: Sequence[Any] | None = None,
    ) -> list[Result]:
        """Run an extraction stage on all items in parallel; return the results in order.

        Args:
            stage: Name of the stage, for progress messages.
            items: Items to process, each by one call of ``work``.
            work: Function that processes one item and returns the result.
            providers: Providers that the stage uses; each provider limits the number of threads.
            local: If true, the stage runs on this machine even if a remote executor is configured.
            remote_items: Small descriptions of the items, which are sent to remote workers instead.
        """
        workers = min((p.workers for p in providers), default=worker_count(self.config.runtime))
        is_cached = (providers or remote_items is not None) and all(p.is_cached for p in providers)
        ahead = (
            self.run_remotely(stage, items if remote_items is None else remote_items)
            if self.run_remotely and is_cached and not local
            else None
        )
        return run_stage(self._events, stage, items, work, workers, ahead)

    def result(
        self,
        provider: ActiveProvider,
        cls: type[Result],
        inputs: Sequence[object],
        compute: Callable[[Any], Result],
        images: Sequence[int] = (),
    ) -> Result:
        """Return a provider's result from the cache, or compute and cache the result.

        If ``runtime.on_error`` is ``skip``, a provider failure gives an empty result, which is not
        cached.

        Args:
            provider: Provider to run.
            cls: Data class of the provider result.
            inputs: Plain data that identifies the input of the provider in the cache.
            compute: Function that computes the result with a provider instance.
            images: Indices of the images of the provider input, for which a failure is recorded.

        Raises:
            ProviderRunError: the provider failed, or too many images failed.
            ProviderOutputError: the provider's output violates the provider contract.
        """
        key = self.key(provider, inputs)
        uncached = provider.can("uncached")
        cache = self.cache if uncached or provider.is_reusable else self._run_cache
        cached = None if uncached else cache.load(provider.kind, key, cls)
        if cached is not None:
            provider.count_cached(key)
            return cached
        may_skip = self.config.runtime.on_error == "skip" and cls in EMPTY_RESULTS and bool(images)
        try:
            if may_skip:
                self._check_known_failure(key)
            value = provider.compute_timed(key, compute, self.config.runtime.timeout_s)
        except (ProviderRunError, ProviderOutputError) as error:
            if not may_skip:
                raise
            if self.shared_run:
                self.cache.store(RUNS, content_key(self.shared_run, key), np.array(str(error)))
            self._record_failure(images, error)
            return cast(Result, EMPTY_RESULTS[cls]())
        if not uncached:
            cache.store(provider.kind, key, value)
        return value

    @cached_property
    def _run_cache(self) -> Cache:
        """Temporary cache of this run, for results of providers whose code cannot be hashed."""
        parent = self.cache.folder.parent / RUNS
        parent.mkdir(parents=True, exist_ok=True)
        folder = mkdtemp(dir=parent)
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return Cache(Path(folder))

    def _check_known_failure(self, key: str) -> None:
        """Raise ProviderRunError if another worker of this run failed on the same result."""
        if self.shared_run:
            known = self.cache.load(RUNS, content_key(self.shared_run, key), np.ndarray)
            if known is not None:
                raise ProviderRunError(str(known))

    def failed(self, images: Sequence[int]) -> bool:
        """Check whether a provider failed on one of the given images in this run."""
        return any(index in self.failures for index in images)

    def _record_failure(self, images: Sequence[int], error: MpsfmError) -> None:
        """Record a provider failure; raise ProviderRunError if over half of the images failed."""
        names = " and ".join(self.images[index].name for index in images)
        _log.warning("a provider failed, so the result for %s is left out: %s", names, error)
        if len(images) > 1:
            self.pair_failures[tuple(images)] = str(error)
            return
        self.failures[images[0]] = str(error)
        if len(self.failures) > len(self.images) / 2:
            count = f"{len(self.failures)} of {len(self.images)} photos"
            raise ProviderRunError(
                f"providers failed on {count}, most recently with: {error}"
            ) from error

    def key(self, provider: ActiveProvider, inputs: Sequence[object]) -> str:
        """Return the cache key of a provider's result."""
        return content_key(provider.identity, list(inputs))

    def view(self, index: int) -> View:
        """Return the undistorted view of an image, masked by the mask providers."""
        view = self.images.view(index)
        return replace(view, mask=self.mask(index)) if self._mask_providers else view

    def view_on_demand(self, index: int) -> View:
        """Return the view of an image, whose pixels and mask are decoded at their first use."""
        image = self.images[index]
        return defer_decoding(
            image.name, image.pinhole, image.orientation, lambda: self.view(index)
        )

    def mask(self, index: int) -> Bool | None:
        """Return the mask (H, W) of usable pixels of a view, or None if all pixels are usable."""
        mask = self.images.mask(index)
        if not self._mask_providers:
            return mask
        width, height = self.images[index].pinhole.size
        bits = np.unpackbits(self._combined_mask(index)[0], count=height * width)
        is_usable = bits.reshape(height, width).astype(np.bool_)
        return is_usable if mask is None else is_usable & mask

    def view_inputs(self, index: int, provider: ActiveProvider) -> list[object]:
        """Return pixels, masks and, if used, intrinsics of a view as parts of a cache key."""
        pixels, *intrinsics = self._unmasked_inputs(index, provider)
        masks = [self._combined_mask(index)[1]] if self._mask_providers else []
        return [pixels, *masks, *intrinsics]

    def _unmasked_inputs(self, index: int, provider: ActiveProvider) -> list[object]:
        inputs: list[object] = [self.images.pixel_key(index)]
        if provider.can("intrinsics-aware"):
            inputs.append(self.images[index].pinhole.params.tolist())
        return inputs

    def load_masks(self) -> None:
        """Create the mask providers; later calls of ``view`` apply their masks."""
        self._mask_providers = [self.provider("mask", backend) for backend in self.config.masks]

    def run_masks(self) -> None:
        """Create the mask providers, and compute the masks of all images."""
        self.load_masks()
        if self._mask_providers:
            self.each("masks", range(len(self.images)), self._combined_mask, *self._mask_providers)

    def _combined_mask(self, index: int) -> tuple[UInt8, str]:
        """Return the logical AND of all masks of an image as packed bits, and its hash."""
        if index not in self._masks:
            combined = np.array(True)
            for provider in self._mask_providers:
                combined = combined & self._mask(provider, index)
            self._masks[index] = np.packbits(combined), digest(combined)
        return self._masks[index]

    def _mask(self, provider: ActiveProvider, index: int) -> Bool:
        return self.result(
            provider,
            np.ndarray,
            self._unmasked_inputs(index, provider),
            lambda instance: run_mask(provider.spec, instance, self.images.view(index)),
        )
