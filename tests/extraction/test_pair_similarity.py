"""Tests of image similarity: match scores, excess over chance, diffusion."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import Features
from mpsfm_core.extraction.pairs import similarity as pair_similarity
from mpsfm_core.extraction.pairs.similarity import (
    NUM_DESCRIPTORS,
    PairSimilarity,
    candidate_pairs,
    compute_vlad,
    diffuse_similarity,
    match_score,
    rank_images,
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


def diffuse(scores: np.ndarray) -> np.ndarray:
    """Diffuse the match scores (n, n) of all pairs; return the similarities (n, n)."""
    pairs = np.stack(np.triu_indices(len(scores), 1), axis=1)
    found = diffuse_similarity(PairSimilarity(pairs, scores[tuple(pairs.T)]), len(scores))
    like = np.zeros(scores.shape)
    like[tuple(pairs.T)] = found.values
    return like + like.T


def test_diffusion_connects_images_with_common_partners() -> None:
    """Images 3 positions apart share no features, but have common partners."""
    like = diffuse(chain(20))
    assert like[10, 11] > like[10, 12] > like[10, 13] > like[10, 16] > 0


def test_diffusion_equals_the_inverse_of_manifold_ranking() -> None:
    """The formula of Zhou et al. (2003) for all images, with a matrix inverse."""
    scores = chain(12)
    sums = scores.sum(axis=1)
    chance = np.outer(sums, sums) / sums.sum()
    excess = np.maximum(scores - chance, 0) / np.sqrt(chance + 1)
    np.fill_diagonal(excess, 0)
    degree = np.sqrt(excess.sum(axis=1))
    links = excess / np.outer(degree, degree)
    expected = np.linalg.inv(np.eye(12) - pair_similarity.DIFFUSION_RATIO * links)
    np.fill_diagonal(expected, 0)
    np.testing.assert_allclose(diffuse(scores), expected, rtol=1e-10, atol=1e-12)


def test_image_similar_to_all_images_has_no_excess() -> None:
    found = chain(20)
    found[7] = found[:, 7] = 20.0
    found[7, 7] = 0
    like = diffuse(found)
    assert like[6, 8] > like[6, 7]


def test_diffusion_without_features_is_zero() -> None:
    assert (diffuse(np.zeros((4, 4))) == 0).all()
    found = chain(12)
    found[5] = found[:, 5] = 0
    like = diffuse(found)
    assert (like[5] == 0).all() and np.isfinite(like).all()


def street(count: int, seed: int = 0) -> list[np.ndarray]:
    """Noisy descriptors of images along a street; 40 of 60 descriptors are in the next image."""
    rng = np.random.default_rng(seed)
    vectors = unit(rng, 20 * (count + 2))
    seen = [vectors[20 * image : 20 * (image + 3)] for image in range(count)]
    return [points + 0.02 * rng.normal(size=points.shape).astype(np.float32) for points in seen]


def test_candidates_contain_overlapping_images() -> None:
    pairs = candidate_pairs(street(120), 8)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(pairs) <= 120 * 8
    chosen = {(a, b) for a, b in pairs.tolist()}
    assert sum((image, image + 1) in chosen for image in range(119)) >= 117


def test_candidates_of_few_images_are_all_pairs() -> None:
    assert candidate_pairs(street(4), 3).tolist() == [
        [0, 1],
        [0, 2],
        [0, 3],
        [1, 2],
        [1, 3],
        [2, 3],
    ]


def test_vlad_of_an_image_without_descriptors_is_zero() -> None:
    vectors = compute_vlad([*street(5), np.zeros((0, 64), dtype=np.float32)])
    lengths = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(lengths, [1, 1, 1, 1, 1, 0], atol=1e-6)


def test_ranked_images_are_a_union_over_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of images have no influence on the result."""
    vectors = np.random.default_rng(0).normal(size=(9, 3))
    products = vectors @ vectors.T
    np.fill_diagonal(products, -np.inf)
    best = {(a, int(b)) for a in range(9) for b in np.argsort(-products[a])[:2]}
    monkeypatch.setattr(pair_similarity, "_BLOCK", 4)
    found = rank_images(vectors, 2)
    assert found.pairs.tolist() == [list(pair) for pair in sorted({(min(p), max(p)) for p in best})]
    np.testing.assert_allclose(found.values, [products[a, b] for a, b in found.pairs])
