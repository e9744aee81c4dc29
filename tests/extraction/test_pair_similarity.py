"""Tests of image similarity: match scores, excess over chance, diffusion."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import Features
from mpsfm_core.extraction.pairs.similarity import (
    NUM_DESCRIPTORS,
    diffuse_similarity,
    match_score,
    strongest_descriptors,
)


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 64)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_strongest_descriptors_have_largest_scores() -> None:
    count = NUM_DESCRIPTORS + 7
    scores = np.random.default_rng(0).permutation(count).astype(np.float32) / count
    descriptors = np.arange(count, dtype=np.float32)[:, None]
    features = Features(np.zeros((count, 2)), descriptors, scores)
    np.testing.assert_array_equal(
        strongest_descriptors(features)[:, 0], np.argsort(-scores)[:NUM_DESCRIPTORS]
    )
    unscored = Features(np.zeros((count, 2)), descriptors)
    np.testing.assert_array_equal(strongest_descriptors(unscored), descriptors[:NUM_DESCRIPTORS])


def test_match_score_grows_with_shared_descriptors() -> None:
    rng = np.random.default_rng(0)
    shared, a, b = (unit(rng, n) for n in (40, 100, 80))
    found = match_score(np.concatenate([a, shared]), np.concatenate([shared, b]))
    assert 40 <= found < 40 + 0.2 * match_score(a, b) + 5
    assert match_score(a, b) < 10


def test_match_score_of_one_mutual_pair() -> None:
    """One mutual pair has distance 1; the second nearest neighbors have distances 5 and 2."""
    a, b = np.array([[0.0, 0.0], [2.0, 1.0]]), np.array([[0.0, 1.0], [3.0, 4.0]])
    assert match_score(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(1 - 1 / 2)


@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (0, 0)])
def test_match_score_without_descriptors_is_zero(counts) -> None:
    a, b = (np.zeros((count, 8), dtype=np.float32) for count in counts)
    assert match_score(a, b) == 0


def test_match_score_of_identical_descriptors_is_finite() -> None:
    same = np.ones((5, 8), dtype=np.float32)
    assert np.isfinite(match_score(same, same))


def chain(count: int, reach: int = 2) -> np.ndarray:
    """Match scores of images along a street: high for neighbors, low for all other pairs."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    found = np.where(apart <= reach, 50.0 / np.maximum(apart, 1), 4.0)
    np.fill_diagonal(found, 0)
    return found


def test_diffusion_connects_images_with_common_partners() -> None:
    """Images 3 positions apart share no features, but have common partners."""
    like = diffuse_similarity(chain(20))
    assert like[10, 11] > like[10, 12] > like[10, 13] > like[10, 16] > 0
    np.testing.assert_allclose(like, like.T)
    assert (np.diag(like) == 0).all()


def test_image_similar_to_all_images_has_no_excess() -> None:
    found = chain(20)
    found[7] = found[:, 7] = 20.0
    found[7, 7] = 0
    like = diffuse_similarity(found)
    assert like[6, 8] > like[6, 7]


def test_diffusion_without_features_is_zero() -> None:
    assert (diffuse_similarity(np.zeros((4, 4))) == 0).all()
    found = chain(12)
    found[5] = found[:, 5] = 0
    like = diffuse_similarity(found)
    assert (like[5] == 0).all() and np.isfinite(like).all()
