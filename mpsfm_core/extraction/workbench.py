"""What the steps of the extraction share: views with their masks, the cache, progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from mpsfm_core import validation
from mpsfm_core.config import Config
from mpsfm_core.data import Bool, UInt8, View
from mpsfm_core.extraction.backends import ActiveProvider
from mpsfm_core.extraction.cache import Cache, content_key, digest
from mpsfm_core.extraction.events import ExtractionEvents
from mpsfm_core.extraction.parallel import run_stage
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.options import Backend
from mpsfm_core.providers import Kind
from mpsfm_core.registry import Registry

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workbench:
    """Runs providers on views and keeps what they return."""

    def __init__(
        self, images: ImageSet, config: Config, registry: Registry, events: ExtractionEvents
    ) -> None:
        self.images = images
        self.config = config
        self.registry = registry
        self.cache = Cache(config.runtime.cache_dir)
        self.providers: list[ActiveProvider] = []
        self._events = events
        self._masks: list[tuple[UInt8, str]] = []

    def provider(self, kind: Kind, backend: Backend) -> ActiveProvider:
        """Take a provider into use."""
        provider = ActiveProvider(kind, backend, self.registry, self.config.runtime)
        self.providers.append(provider)
        return provider

    def each(
        self, stage: str, items: Sequence[Item], work: Callable[[Item], Result], workers: int
    ) -> list[Result]:
        """One stage: work on all items in parallel, in their order."""
        return run_stage(self._events, stage, items, work, workers)

    def result(
        self,
        provider: ActiveProvider,
        cls: type[Result],
        inputs: Sequence[object],
        compute: Callable[[Any], Result],
    ) -> Result:
        """What a provider returns for inputs that plain data identifies: cached, or computed."""
        key = self.key(provider, inputs)
        if provider.can("uncached"):
            return provider.timed(key, compute)
        found = self.cache.load(provider.kind, key, cls)
        if found is not None:
            provider.count_cached(key)
            return found
        value = provider.timed(key, compute)
        self.cache.store(provider.kind, key, value)
        return value

    def key(self, provider: ActiveProvider, inputs: Sequence[object]) -> str:
        """Names a result of a provider by all it depends on."""
        return content_key(provider.identity, list(inputs))

    def view(self, index: int) -> View:
        """The view of an image, its mask restricted by the mask providers."""
        view = self.images.view(index)
        return replace(view, mask=self.mask(index)) if self._masks else view

    def mask(self, index: int) -> Bool | None:
        """Which pixels of a view may be used, None for all."""
        mask = self.images.mask(index)
        if not self._masks:
            return mask
        width, height = self.images[index].pinhole.size
        bits = np.unpackbits(self._masks[index][0], count=height * width)
        allowed = bits.reshape(height, width).astype(np.bool_)
        return allowed if mask is None else allowed & mask

    def view_inputs(self, index: int, provider: ActiveProvider) -> list[object]:
        """What identifies a view for a provider: pixels, masks, and intrinsics if it uses them."""
        inputs: list[object] = [self.images.pixel_key(index)]
        if self._masks:
            inputs.append(self._masks[index][1])
        if provider.can("intrinsics-aware"):
            inputs.append(self.images[index].pinhole.params.tolist())
        return inputs

    def run_masks(self) -> None:
        """Run all mask providers; views have their masks from then on."""
        active = [self.provider("mask", backend) for backend in self.config.masks]
        if not active:
            return

        def allowed(index: int) -> tuple[UInt8, str]:
            together = np.array(True)
            for provider in active:
                together = together & self._mask(provider, index)
            return np.packbits(together), digest(together)

        workers = min(provider.workers for provider in active)
        self._masks = self.each("masks", range(len(self.images)), allowed, workers)

    def _mask(self, provider: ActiveProvider, index: int) -> Bool:
        return self.result(
            provider,
            np.ndarray,
            self.view_inputs(index, provider),
            lambda instance: validation.run_mask(provider.spec, instance, self.images.view(index)),
        )
