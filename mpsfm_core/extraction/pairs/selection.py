"""Selection of the image pairs to match, and of further pairs between components."""

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
from mpsfm_core.extraction.features import FeatureSource
from mpsfm_core.extraction.pairs import pairing as pairs
from mpsfm_core.extraction.pairs import similarity as pair_similarity
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.extraction.pairs.similarity import PairSimilarity
from mpsfm_core.providers.kinds.retrieval import run_retrieval
from mpsfm_core.providers.source_hash import hash_module


class PairSelection:
    """Selects the image pairs that are matched.

    Args:
        context: Context of the extraction with options, cache and progress.
        table: Features of the images, or None without a feature provider.
        unconstrained: Images to match again after the fast first pass, of which each pair contains
            at least one; if None, all pairs are allowed.
        images: Indices of the images, without duplicates; by default all images of the context.
    """

    def __init__(
        self,
        context: ExtractionContext,
        table: FeatureSource | None,
        unconstrained: Collection[int] | None = None,
        images: Sequence[int] | None = None,
    ) -> None:
        self.proposed = 0
        """Number of selected image pairs before plugins filter the pairs."""
        self._unconstrained = unconstrained
        self._context = context
        self._images = range(len(context.images)) if images is None else images
        self._table = table
        self._similarity: PairSimilarity | None = None
        self._selected: set[Pair] = set()

    def choose(self) -> list[Pair]:
        """Select the image pairs that are matched first.

        Raises:
            ConfigError: ``pairs.mode`` is ``retrieval``, but no retrieval provider is configured.
        """
        options, count = self._context.config.pairs, len(self._images)
        if options.mode == "sequential":
            return self._select_rows(pairs.sequential_pairs(count, options))
        if options.mode == "retrieval":
            return self._select_rows(pairs.retrieval_pairs(self._descriptors(), options))
        if options.mode == "exhaustive" or count - 1 <= options.partners:
            return self._select_rows(pairs.exhaustive_pairs(count))
        self._similarity = self._compute_similarity()
        if self._similarity is None:
            return self._select_rows(pairs.exhaustive_pairs(count))
        similar = pairs.most_similar_pairs(
            self._similarity, self._partners, images=self._unconstrained
        )
        names = [self._context.images[image].name for image in self._images]
        neighbors = pairs.numbered_neighbor_pairs(names, options)
        return self._select(similar + self._number_pairs(neighbors))

    def choose_references(self, num_references: int) -> list[Pair]:
        """Pair each query image with its most similar images of a model.

        The similarity is the dot product of global descriptors with a retrieval provider, else the
        match score of local features. All images of the model are chosen if they are not more than
        ``pairs.partners``, or without features.

        Args:
            num_references: Number of images of the model. These images are the first images of the
                set, and all other images are queries.
        """
        options, count = self._context.config.pairs, len(self._context.images)
        by_retrieval = self._context.config.retrieval is not None
        num_chosen = options.top_k if options.mode == "retrieval" else options.partners
        if num_references <= num_chosen or not (by_retrieval or self._table):
            num_chosen = num_references
            rank = np.zeros((count - num_references, num_references))
        elif by_retrieval:
            descriptors = np.stack(self._descriptors()).astype(np.float64)
            rank = descriptors[num_references:] @ descriptors[:num_references].T
        else:
            rank = self._score_references(num_references)
        best = np.argsort(-rank, axis=1, kind="stable")[:, :num_chosen]
        return self._select(
            [(int(b), num_references + row) for row, chosen in enumerate(best) for b in chosen]
        )

    def _score_references(self, num_references: int) -> Float64:
        """Return the match scores (queries, references) of local features."""
        table, context = self._table, self._context
        assert table is not None
        references = [
            pair_similarity.strongest_descriptors(table[index]) for index in range(num_references)
        ]

        def score(query: int) -> list[float]:
            strongest = pair_similarity.strongest_descriptors(table[query])
            return [pair_similarity.match_score(strongest, other) for other in references]

        queries = range(num_references, len(context.images))
        return np.array(context.each("similarity", queries, score))

    def choose_again(self, verified: Sequence[Pair]) -> list[Pair]:
        """Select further image pairs between the components of the match graph.

        Each component except the largest gets its most similar unmatched pairs with images of other
        components. Only ``pairs.mode: auto`` selects further pairs.
        """
        if self._similarity is None:
            return []
        count = len(self._context.images)
        rows, columns = np.array(verified, dtype=np.int64).reshape(-1, 2).T
        graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        num_components, component_of = connected_components(graph, directed=False)
        sizes = np.bincount(component_of, minlength=num_components)
        candidates, values = self._similarity
        ranked = candidates[np.lexsort((candidates[:, 1], candidates[:, 0], -values))]
        further: list[Pair] = []
        for component in np.flatnonzero(np.arange(num_components) != sizes.argmax()):
            inside = component_of[ranked] == component
            across = ranked[inside[:, 0] != inside[:, 1]].tolist()
            untried = [(a, b) for a, b in across if (a, b) not in self._selected]
            further += untried[: self._context.config.pairs.partners]
        return self._select(further)

    @property
    def _partners(self) -> int:
        """Number of images that each image is matched with."""
        config = self._context.config
        if self._unconstrained is None or config.fast_pass is None:
            return config.pairs.partners
        return config.fast_pass.partners

    def _number_pairs(self, rows: Sequence[Pair]) -> list[Pair]:
        """Convert pairs of positions in the list of distinct images to pairs of image indices."""
        return [(self._images[a], self._images[b]) for a, b in rows]

    def _select_rows(self, rows: Sequence[Pair]) -> list[Pair]:
        return self._select(self._number_pairs(rows))

    def _select(self, chosen: Sequence[Pair]) -> list[Pair]:
        """Sort and record image pairs, and apply the pair filters of plugins."""
        images, untried = self._unconstrained, set(chosen) - self._selected
        unique = sorted((a, b) for a, b in untried if images is None or a in images or b in images)
        self._selected.update(unique)
        self.proposed += len(unique)
        names = self._context.images.names
        named = [(names[a], names[b]) for a, b in unique]
        answers = self._context.registry.call_hook("mpsfm_filter_pairs", pairs=named)
        return pairs.filter_pairs(unique, names, answers)

    def _compute_similarity(self) -> PairSimilarity | None:
        """Compute the similarity of candidate pairs by retrieval, or else by local features.

        The similarity is None if neither a retrieval provider nor a feature provider is configured.
        """
        if self._context.config.retrieval is not None:
            descriptors = np.stack(self._descriptors()).astype(np.float64)
            found = pair_similarity.rank_images(
                descriptors, self._context.config.pairs.num_candidates
            )
        elif self._table is None:
            return None
        else:
            scores = self._match_scores(self._table)
            found = pair_similarity.diffuse_similarity(scores, len(self._images))
        return PairSimilarity(np.asarray(self._images)[found.pairs], found.values)

    def _match_scores(self, table: FeatureSource) -> PairSimilarity:
        """Return the match scores of candidate pairs of positions in the list of images."""
        context, count = self._context, len(self._images)
        num_candidates = context.config.pairs.num_candidates
        key = content_key(
            hash_module(pair_similarity.__name__),
            [table.key(image) for image in self._images],
            num_candidates,
        )
        cached: Float64 | None = context.cache.load("pair-similarity", key, np.ndarray)
        if cached is not None:
            return PairSimilarity(cached[:, :2].astype(np.int64), cached[:, 2])
        strongest = [pair_similarity.strongest_descriptors(table[image]) for image in self._images]
        pairs = pair_similarity.candidate_pairs(strongest, num_candidates)
        partners = np.split(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(1, count)))

        def compare(first: int) -> list[float]:
            a = strongest[first]
            return [pair_similarity.match_score(a, strongest[b]) for b in partners[first]]

        rows = context.each("similarity", range(count), compare)
        scores = np.array([score for row in rows for score in row], dtype=np.float64)
        context.cache.store("pair-similarity", key, np.column_stack([pairs, scores]))
        return PairSimilarity(pairs, scores)

    def describe(self, index: int) -> Any:
        """Return the cached or computed global descriptor (d,) of an image.

        Raises:
            ConfigError: no retrieval provider is configured.
        """
        context, provider = self._context, self._retrieval
        return context.result(
            provider,
            np.ndarray,
            context.view_inputs(index, provider),
            lambda instance: run_retrieval(provider.spec, instance, context.view(index)),
        )

    def _descriptors(self) -> list[Any]:
        return self._context.each("retrieval", self._images, self.describe, self._retrieval)

    @cached_property
    def _retrieval(self) -> ActiveProvider:
        backend = self._context.config.retrieval
        if backend is None:
            raise ConfigError("pairs.mode: 'retrieval' needs a provider: set retrieval.use")
        return self._context.provider("retrieval", backend)
