"""Which pairs of a set of photos are matched: chosen before, and again where photos stay apart."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.cache import content_key
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.pairs import pairing as pairs
from mpsfm_core.extraction.pairs import similarity as first_look
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.providers import validation


class PairSelection:
    """Chooses pairs for the matcher; ``proposed`` counts those before the filters of plugins.

    ``loose``: images that are matched again, of which one must be in a pair; None for any pair.
    """

    def __init__(
        self,
        context: ExtractionContext,
        table: FeatureTable | None,
        loose: Collection[int] | None = None,
    ) -> None:
        self.proposed = 0
        self._loose = loose
        self._context = context
        self._table = table
        self._likeness: Float64 | None = None
        self._asked: set[Pair] = set()

    def choose(self) -> list[Pair]:
        """The pairs to match.

        Raises :class:`ConfigError` when retrieval is asked for without a provider.
        """
        options, count = self._context.config.pairs, len(self._context.images)
        if options.mode == "sequential":
            return self._ask(pairs.sequential_pairs(count, options))
        if options.mode == "retrieval":
            return self._ask(pairs.retrieval_pairs(self._descriptors(), options))
        if options.mode == "exhaustive" or count - 1 <= options.partners:
            return self._ask(pairs.exhaustive_pairs(count))
        self._likeness = self._look()
        if self._likeness is None:
            return self._ask(pairs.exhaustive_pairs(count))
        alike = pairs.most_similar_pairs(self._likeness, self._partners, images=self._loose)
        return self._ask(alike + pairs.numbered_neighbor_pairs(self._context.images.names, options))

    def choose_again(self, verified: Sequence[Pair]) -> list[Pair]:
        """More pairs where the verified ones leave photos apart: for each group but the largest,
        those most like photos outside that were not tried. None where all was decided before."""
        if self._likeness is None:
            return []
        count = len(self._likeness)
        rows, columns = np.array(verified, dtype=np.int64).reshape(-1, 2).T
        graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        groups, group_of = connected_components(graph, directed=False)
        sizes = np.bincount(group_of, minlength=groups)
        more: list[Pair] = []
        for group in np.flatnonzero(np.arange(groups) != sizes.argmax()):
            inside = group_of == group
            across = [
                (min(a, b), max(a, b))
                for a in np.flatnonzero(inside).tolist()
                for b in np.flatnonzero(~inside).tolist()
            ]
            untried = [pair for pair in across if pair not in self._asked]
            untried.sort(key=lambda pair: (-self._like(pair), pair))
            more += untried[: self._context.config.pairs.partners]
        return self._ask(more)

    @property
    def _partners(self) -> int:
        """Of each photo that asks for them."""
        config = self._context.config
        if self._loose is None or config.fast_pass is None:
            return config.pairs.partners
        return config.fast_pass.partners

    def _like(self, pair: Pair) -> float:
        return 0.0 if self._likeness is None else float(self._likeness[pair])

    def _ask(self, chosen: Sequence[Pair]) -> list[Pair]:
        """The pairs that plugins let pass, sorted, each once."""
        loose = self._loose
        unique = sorted({(a, b) for a, b in chosen if loose is None or a in loose or b in loose})
        self._asked.update(unique)
        self.proposed += len(unique)
        names = self._context.images.names
        named = [(names[a], names[b]) for a, b in unique]
        answers = self._context.registry.call_hook("mpsfm_filter_pairs", pairs=named)
        return pairs.filter_pairs(unique, names, answers)

    def _look(self) -> Float64 | None:
        """Likeness of all photos (n, n): by retrieval where it is configured, else by features;
        None where there is neither."""
        backend = self._context.config.retrieval
        if backend is not None:
            descriptors = np.stack(self._descriptors()).astype(np.float64)
            similarity: Float64 = np.maximum(descriptors @ descriptors.T, 0)
            return similarity
        if self._table is None:
            return None
        return first_look.diffuse_similarity(self._evidence(self._table))

    def _evidence(self, table: FeatureTable) -> Float64:
        context, count = self._context, len(self._context.images)
        key = content_key(first_look.NUM_DESCRIPTORS, [table.key(index) for index in range(count)])
        cached: Float64 | None = context.cache.load("first-look", key, np.ndarray)
        if cached is not None:
            return cached
        strongest = [first_look.strongest_descriptors(table[index]) for index in range(count)]
        found = np.zeros((count, count))

        def compare(first: int) -> None:
            for other in range(first + 1, count):
                found[first, other] = first_look.match_score(strongest[first], strongest[other])

        context.each("first look", range(count), compare)
        found += found.T
        context.cache.store("first-look", key, found)
        return found

    def describe(self, index: int) -> Any:
        """The global descriptor (d,) of an image, cached.

        Raises :class:`ConfigError` without a retrieval provider.
        """
        context, provider = self._context, self._retrieval
        return context.result(
            provider,
            np.ndarray,
            context.view_inputs(index, provider),
            lambda instance: validation.run_retrieval(provider.spec, instance, context.view(index)),
        )

    def _descriptors(self) -> list[Any]:
        images = range(len(self._context.images))
        return self._context.each("retrieval", images, self.describe, self._retrieval)

    @cached_property
    def _retrieval(self) -> ActiveProvider:
        backend = self._context.config.retrieval
        if backend is None:
            raise ConfigError("pairs.mode: 'retrieval' needs a provider: set retrieval.use")
        return self._context.provider("retrieval", backend)
