"""Extraction of features, without the features in masked areas."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from mpsfm_core.data import Features
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.providers.kinds.features import run_features
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.support.lru_cache import LruCache

CACHED_BYTES = 512 << 20
"""Size limit of the in-memory feature cache, bytes; 8192 SIFT features take 4 MB."""


NO_FEATURES = Features(np.empty((0, 2)), np.empty((0, 0), dtype=np.float32))


class FeatureSource(Protocol):
    """Features of the images of a run, by image index."""

    def extract(self, images: Sequence[int]) -> list[Features]:
        """Return the features of images, possibly without descriptors to save memory."""

    def __getitem__(self, index: int) -> Features:
        """Return the features of an image with descriptors."""

    def key(self, index: int) -> str:
        """Return a text that identifies the features of an image in cache keys."""


class FeatureTable:
    """Features of each image without masked areas, in an LRU cache in front of the disk cache."""

    def __init__(self, context: ExtractionContext, backend: ProviderConfig) -> None:
        self._context = context
        self._provider = context.provider("features", backend)
        self._recent: LruCache[int, Features] = LruCache(
            CACHED_BYTES, lambda f: f.descriptors.nbytes
        )

    def extract(self, images: Sequence[int]) -> list[Features]:
        """Compute features of images; return them without descriptors, to limit memory."""
        return self._context.each("features", images, self._without_descriptors, self._provider)

    def __getitem__(self, index: int) -> Features:
        return self._recent.get(index, lambda: self._load(index))

    def key(self, index: int) -> str:
        """Return the cache key of the features of an image."""
        if not self._provider.is_cached:
            return digest(self[index])
        return self._context.key(self._provider, self._context.view_inputs(index, self._provider))

    def _without_descriptors(self, index: int) -> Features:
        features = self[index]
        return Features(
            features.keypoints,
            np.empty((len(features), 0), dtype=np.float32),
            std_px=features.std_px,
        )

    def _load(self, index: int) -> Features:
        def compute(instance: Any) -> Features:
            return run_features(self._provider.spec, instance, self._context.view(index))

        inputs = self._context.view_inputs(index, self._provider)
        features = self._context.result(self._provider, Features, inputs, compute, [index])
        mask = self._context.mask(index)
        if mask is None:
            return features
        return features.select(sample_nearest(mask, features.keypoints))


class SharedFeatures:
    """Feature source in which duplicates have the features of their originals.

    Args:
        source: Features of the originals.
        originals: Index of the original image by index of the duplicate.
    """

    def __init__(self, source: FeatureSource, originals: Mapping[int, int]) -> None:
        self._source = source
        self._originals = originals

    def extract(self, images: Sequence[int]) -> list[Features]:
        """Return the features of images; the features of a duplicate are not computed."""
        distinct = sorted({self._originals.get(index, index) for index in images})
        features = dict(zip(distinct, self._source.extract(distinct), strict=True))
        return [features[self._originals.get(index, index)] for index in images]

    def __getitem__(self, index: int) -> Features:
        return self._source[self._originals.get(index, index)]

    def key(self, index: int) -> str:
        """Return a text that identifies the features of an image in cache keys."""
        return self._source.key(self._originals.get(index, index))


class FeatureSet(Mapping[str, Features]):
    """Features of each image by name, loaded from the cache on access.

    Attributes:
        source: Source of the features, with access by image index.
        provider: Configuration of the features provider, or None for features that the caller
            computed.
    """

    def __init__(
        self, names: list[str], source: FeatureSource, provider: ProviderConfig | None
    ) -> None:
        self.provider = provider
        self._rows = {name: row for row, name in enumerate(names)}
        self.source = source

    def __getitem__(self, name: str) -> Features:
        return self.source[self._rows[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


class GivenFeatures:
    """Feature source with features that the caller computed."""

    def __init__(self, names: list[str], features: Mapping[str, Features]) -> None:
        for name, given in features.items():
            if not isinstance(given, Features):
                raise InputError(
                    f"features of {name!r}: expected mpsfm_core.Features, got "
                    f"{type(given).__name__}; use Features.from_arrays(keypoints, descriptors)"
                )
        self._features = [features.get(name, NO_FEATURES) for name in names]

    def extract(self, images: Sequence[int]) -> list[Features]:
        """Return the features of images."""
        return [self._features[index] for index in images]

    def __getitem__(self, index: int) -> Features:
        return self._features[index]

    def key(self, index: int) -> str:
        """Return the hash of the features of an image."""
        return digest(self._features[index])
