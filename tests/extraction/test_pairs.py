"""Tests of pair generation."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.pairs.pairing import (
    exhaustive_pairs,
    filter_pairs,
    most_similar_pairs,
    numbered_neighbor_pairs,
    retrieval_pairs,
    sequential_pairs,
)
from mpsfm_core.extraction.pairs.similarity import PairSimilarity


def test_exhaustive_pairs_are_all_pairs() -> None:
    assert exhaustive_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    assert exhaustive_pairs(1) == []
    assert len(exhaustive_pairs(20)) == 190


def test_sequential_pairs_are_following_images() -> None:
    assert sequential_pairs(4, PairOptions(overlap=2)) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert sequential_pairs(2, PairOptions(overlap=5)) == [(0, 1)]


def test_quadratic_pairs_have_distances_of_powers_of_two() -> None:
    pairs = sequential_pairs(10, PairOptions(overlap=4, quadratic=True))
    assert [b for a, b in pairs if a == 0] == [1, 2, 4, 8]


def unit(*angles_deg: float) -> list[np.ndarray]:
    radians = np.radians(angles_deg)
    return list(np.stack([np.cos(radians), np.sin(radians)], axis=1).astype(np.float32))


def test_retrieval_pairs_are_most_similar() -> None:
    pairs = retrieval_pairs(unit(0, 10, 40, 45), PairOptions(top_k=1))
    assert pairs == [(0, 1), (2, 3)]


def test_retrieval_pairs_are_a_union_over_images() -> None:
    """Image 2 is paired with its most similar image 1, although 1 is more similar to 0."""
    assert retrieval_pairs(unit(0, 10, 40), PairOptions(top_k=1)) == [(0, 1), (1, 2)]


@pytest.mark.parametrize(("least", "expected"), [(0.0, [(0, 1)]), (-1.0, [(0, 1), (0, 2), (1, 2)])])
def test_retrieval_pairs_respect_min_similarity(least, expected) -> None:
    descriptors = unit(0, 10, 150)
    assert retrieval_pairs(descriptors, PairOptions(min_similarity=least)) == expected


def test_retrieval_never_pairs_an_image_with_itself() -> None:
    options = PairOptions(top_k=5, min_similarity=-np.inf)
    assert retrieval_pairs(unit(0, 0, 0), options) == [(0, 1), (0, 2), (1, 2)]


def test_filter_pairs_intersects_and_ignores_order() -> None:
    names = ["a", "b", "c"]
    pairs = [(0, 1), (0, 2), (1, 2)]
    assert filter_pairs(pairs, names, []) == pairs
    answers = [[("b", "a"), ("a", "c")], [("a", "b"), ("b", "c"), ("x", "y")]]
    assert filter_pairs(pairs, names, answers) == [(0, 1)]
    assert filter_pairs(pairs, names, [[]]) == []


def similarity(values: dict[tuple[int, int], float]) -> PairSimilarity:
    return PairSimilarity(np.array(list(values)), np.array(list(values.values())))


def test_most_similar_pairs_exclude_zero_similarity() -> None:
    likeness = similarity({(0, 1): 3.0, (0, 2): 0.0, (1, 2): 1.0, (2, 3): 0.0})
    assert most_similar_pairs(likeness, 1) == [(0, 1), (1, 2)]
    assert most_similar_pairs(likeness, 3) == [(0, 1), (1, 2)]


def test_most_similar_pairs_of_selected_images() -> None:
    """Only the selected images get partners."""
    likeness = similarity({(0, 1): 3.0, (0, 2): 1.0, (1, 2): 2.0, (2, 3): 5.0})
    assert most_similar_pairs(likeness, 1, images=[0]) == [(0, 1)]
    assert most_similar_pairs(likeness, 2, images=[3, 0]) == [(0, 1), (0, 2), (2, 3)]


def test_numbered_neighbor_pairs_follow_numbers_in_names() -> None:
    """Two sequences, one with a gap and in another order, and a name without sequence."""
    names = ["a_9.png", "a_10.png", "a_3.png", "b1/7.jpg", "cover.png", "b1/8.jpg", "b2/9.jpg"]
    assert numbered_neighbor_pairs(names, PairOptions(overlap=1)) == [(0, 1), (0, 2), (3, 5)]
    assert numbered_neighbor_pairs(names, PairOptions(overlap=2)) == [
        (0, 1),
        (0, 2),
        (1, 2),
        (3, 5),
    ]
