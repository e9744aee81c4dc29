"""What the steps of the extraction share: views with their masks, the cache, progress."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from mpsfm_core.config import Config
from mpsfm_core.data import Bool, UInt8, View
from mpsfm_core.data.errors import MpsfmError, ProviderOutputError, ProviderRunError
from mpsfm_core.extraction.active_provider import ActiveProvider, worker_count
from mpsfm_core.extraction.cache import Cache, content_key, digest
from mpsfm_core.extraction.empty_results import EMPTY_RESULTS
from mpsfm_core.extraction.events import ExtractionEvents
from mpsfm_core.extraction.parallel import run_stage
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.providers import Kind, validation
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

_log = logging.getLogger(__name__)

RUNS = "run"
"""Kind of cache entry that the workers of one run leave for each other."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class ExtractionContext:
    """Runs providers on views and keeps what they return.

    ``failures``: images that the run goes on without -> what a provider failed with.
    """

    def __init__(
        self, images: ImageSet, config: Config, registry: Registry, events: ExtractionEvents
    ) -> None:
        self.images = images
        self.config = config
        self.registry = registry
        self.cache = Cache(config.runtime.cache_dir)
        self.providers: list[ActiveProvider] = []
        self.failures: dict[int, str] = {}
        self._events = events
        self.elsewhere: Callable[[str, Sequence[Any]], Generator[None, None, None]] | None = None
        """Runs a stage on the workers of an executor, where there is one."""
        self.shared_run = ""
        """Names the run to the workers of an executor: all know what a provider failed on."""
        self._mask_providers: list[ActiveProvider] = []
        self._masks: dict[int, tuple[UInt8, str]] = {}

    def provider(self, kind: Kind, backend: ProviderConfig) -> ActiveProvider:
        """Take a provider into use."""
        provider = ActiveProvider(kind, backend, self.registry, self.config.runtime)
        self.providers.append(provider)
        return provider

    def each(
        self,
        stage: str,
        items: Sequence[Item],
        work: Callable[[Item], Result],
        *providers: ActiveProvider,
        here: bool = False,
    ) -> list[Result]:
        """One stage: work on all items in parallel, in their order.

        ``providers``: what it asks, if anything. ``here``: not on an executor's workers, even if
        the cache would keep what they find.
        """
        workers = min((p.workers for p in providers), default=worker_count(self.config.runtime))
        kept = providers and not any(provider.can("uncached") for provider in providers)
        ahead = self.elsewhere(stage, items) if self.elsewhere and kept and not here else None
        return run_stage(self._events, stage, items, work, workers, ahead)

    def result(
        self,
        provider: ActiveProvider,
        cls: type[Result],
        inputs: Sequence[object],
        compute: Callable[[Any], Result],
        images: Sequence[int] = (),
    ) -> Result:
        """What a provider returns for inputs that plain data identifies: cached, or computed.

        ``images``: those that it is about. Where ``runtime.on_error`` says so, a provider that
        fails on one gives nothing for it, which is not cached.
        """
        key = self.key(provider, inputs)
        uncached = provider.can("uncached")
        found = None if uncached else self.cache.load(provider.kind, key, cls)
        if found is not None:
            provider.count_cached(key)
            return found
        may_skip = self.config.runtime.on_error == "skip" and cls in EMPTY_RESULTS and bool(images)
        try:
            if may_skip:
                self._check_known_failure(key)
            value = provider.timed(key, compute, self.config.runtime.timeout_s)
        except (ProviderRunError, ProviderOutputError) as error:
            if not may_skip:
                raise
            if self.shared_run:
                self.cache.store(RUNS, content_key(self.shared_run, key), np.array(str(error)))
            self._note_failure(images, error)
            return cast(Result, EMPTY_RESULTS[cls]())
        if not uncached:
            self.cache.store(provider.kind, key, value)
        return value

    def _check_known_failure(self, key: str) -> None:
        """Raise what a provider failed with on another worker of this run: once is enough."""
        if self.shared_run:
            known = self.cache.load(RUNS, content_key(self.shared_run, key), np.ndarray)
            if known is not None:
                raise ProviderRunError(str(known))

    def failed(self, images: Sequence[int]) -> bool:
        """Whether a provider failed on one of the images: nothing more is asked about it."""
        return any(index in self.failures for index in images)

    def _note_failure(self, images: Sequence[int], error: MpsfmError) -> None:
        """Remember it; raises the error once more than half of the images have failed."""
        names = " and ".join(self.images[index].name for index in images)
        _log.warning("%s goes on without it: %s", names, error)
        if len(images) == 1:
            self.failures[images[0]] = str(error)
        if len(self.failures) > len(self.images) / 2:
            count = f"{len(self.failures)} of {len(self.images)} photos failed"
            raise ProviderRunError(f"{count}, the last so: {error}") from error

    def key(self, provider: ActiveProvider, inputs: Sequence[object]) -> str:
        """Names a result of a provider by all it depends on."""
        return content_key(provider.identity, list(inputs))

    def view(self, index: int) -> View:
        """The view of an image, its mask restricted by the mask providers."""
        view = self.images.view(index)
        return replace(view, mask=self.mask(index)) if self._mask_providers else view

    def mask(self, index: int) -> Bool | None:
        """Which pixels of a view may be used, None for all."""
        mask = self.images.mask(index)
        if not self._mask_providers:
            return mask
        width, height = self.images[index].pinhole.size
        bits = np.unpackbits(self._allowed(index)[0], count=height * width)
        allowed = bits.reshape(height, width).astype(np.bool_)
        return allowed if mask is None else allowed & mask

    def view_inputs(self, index: int, provider: ActiveProvider) -> list[object]:
        """What identifies a view for a provider: pixels, masks, and intrinsics if it uses them."""
        pixels, *intrinsics = self._unmasked_inputs(index, provider)
        masks = [self._allowed(index)[1]] if self._mask_providers else []
        return [pixels, *masks, *intrinsics]

    def _unmasked_inputs(self, index: int, provider: ActiveProvider) -> list[object]:
        inputs: list[object] = [self.images.pixel_key(index)]
        if provider.can("intrinsics-aware"):
            inputs.append(self.images[index].pinhole.params.tolist())
        return inputs

    def take_masks(self) -> None:
        """Take the mask providers into use; views have their masks from then on."""
        self._mask_providers = [self.provider("mask", backend) for backend in self.config.masks]

    def run_masks(self) -> None:
        """Take the mask providers into use, and run them all."""
        self.take_masks()
        if self._mask_providers:
            self.each("masks", range(len(self.images)), self._allowed, *self._mask_providers)

    def _allowed(self, index: int) -> tuple[UInt8, str]:
        """Where all mask providers allow it, packed, and its digest."""
        if index not in self._masks:
            together = np.array(True)
            for provider in self._mask_providers:
                together = together & self._mask(provider, index)
            self._masks[index] = np.packbits(together), digest(together)
        return self._masks[index]

    def _mask(self, provider: ActiveProvider, index: int) -> Bool:
        return self.result(
            provider,
            np.ndarray,
            self._unmasked_inputs(index, provider),
            lambda instance: validation.run_mask(provider.spec, instance, self.images.view(index)),
        )
