"""Generation of image pairs, either exhaustive, sequential, by similarity or by file number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from mpsfm_core.data import Float32
from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.pairs.similarity import PairSimilarity, rank_images

Pair = tuple[int, int]
"""Indices of the two images of a pair, the smaller index first."""

_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")


def exhaustive_pairs(count: int) -> list[Pair]:
    """Return all pairs of ``count`` images."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def sequential_pairs(count: int, options: PairOptions) -> list[Pair]:
    """Pair each image with following images; quadratic mode uses distances 1, 2, 4, 8 ..."""
    steps = range(options.overlap)
    offsets = [2**step if options.quadratic else step + 1 for step in steps]
    return _sort_pairs((a, a + d) for a in range(count) for d in offsets if a + d < count)


def retrieval_pairs(descriptors: Sequence[Float32], options: PairOptions) -> list[Pair]:
    """Pair each image with the images of largest dot product of global descriptors (d,)."""
    ranked = rank_images(np.stack(descriptors).astype(np.float64), options.top_k)
    return [
        (a, b)
        for (a, b), value in zip(ranked.pairs.tolist(), ranked.values.tolist(), strict=True)
        if value >= options.min_similarity
    ]


def most_similar_pairs(
    similarity: PairSimilarity, count: int, images: Iterable[int] | None = None
) -> list[Pair]:
    """Pair images with the images of largest similarity, if the similarity is above 0.

    Args:
        similarity: Similarity of the candidate pairs.
        count: Number of most similar images that each image is paired with.
        images: Indices of the images that are paired with similar images; default: all images.
    """
    both = np.concatenate([similarity.pairs, similarity.pairs[:, ::-1]])
    values = np.tile(similarity.values, 2)
    kept = values > 0
    if images is not None:
        kept &= np.isin(both[:, 0], list(images))
    both, values = both[kept], values[kept]
    both = both[np.lexsort((both[:, 1], -values, both[:, 0]))]
    rank = np.arange(len(both)) - np.searchsorted(both[:, 0], both[:, 0])
    return _sort_pairs((a, b) for a, b in both[rank < count].tolist())


def numbered_neighbor_pairs(names: Sequence[str], options: PairOptions) -> list[Pair]:
    """Pair each image with the next images of its sequence of numbered file names.

    Images form a sequence if their names differ only in the last number, which gives the order.
    """
    sequences: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for index, name in enumerate(names):
        match = _NUMBERED.fullmatch(name)
        if match is not None:
            prefix, number, suffix = match.groups()
            sequences.setdefault((prefix, suffix), []).append((int(number), index))
    return _sort_pairs(
        (sequence[a][1], sequence[b][1])
        for sequence in map(sorted, sequences.values())
        for a, b in sequential_pairs(len(sequence), options)
    )


def filter_pairs(
    pairs: Sequence[Pair], names: Sequence[str], answers: Iterable[Iterable[tuple[str, str]]]
) -> list[Pair]:
    """Select the image pairs that the filters of all plugins accept.

    Args:
        pairs: Image pairs as image indices.
        names: Names of all images.
        answers: Pairs of image names that each plugin's filter accepts, in any order.
    """
    accepted = [frozenset(frozenset(pair) for pair in answer) for answer in answers]
    return [
        (a, b)
        for a, b in pairs
        if all(frozenset((names[a], names[b])) in answer for answer in accepted)
    ]


def _sort_pairs(pairs: Iterable[Pair]) -> list[Pair]:
    """Sort the image pairs and the two images of each pair; drop duplicate pairs."""
    return sorted({(min(pair), max(pair)) for pair in pairs})
