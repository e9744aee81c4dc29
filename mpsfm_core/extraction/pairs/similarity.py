"""Image similarity from a few local features, to select image pairs without retrieval.

The match score of two images counts mutual nearest neighbors among their strongest descriptors,
each weighted by 1 minus the ratio of its nearest to its second nearest distance. The similarity is
the match score minus the score that both images reach by chance, because images with repetitive
texture match many images. Diffusion of the similarities raises the similarity of two images that
are both similar to a third image. Diffusion finds pairs of small overlap (Zhou et al., Ranking on
Data Manifolds, NIPS 2003).

Match scores are computed for candidate pairs only, so that their time per image does not grow with
the number of images. The candidates of an image are the images with the most similar global
descriptors (VLAD of the strongest descriptors: Jegou et al., CVPR 2010; Arandjelovic and Zisserman,
CVPR 2013).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.sparse import csr_array

from mpsfm_core.data import Features, Float32, Float64, Int64
from mpsfm_core.providers.builtin.mutual_nearest import mutual_nearest

NUM_DESCRIPTORS = 384
"""Number of descriptors per image that are compared. The cost of comparison grows with the square
of the number of descriptors. [tuned: benchmarks.pairs]"""
DIFFUSION_RATIO = 0.8
"""Diffusion weight ``alpha`` of manifold ranking. [tuned: benchmarks.pairs]"""
_NUM_CLUSTERS = 64
"""Number of clusters of a VLAD descriptor."""
_TRAINING_DESCRIPTORS = 256 * _NUM_CLUSTERS
"""Number of descriptors of all images that the clusters are computed from."""
_BLOCK = 256
"""Number of images whose similarity to all images is in memory at once."""
_TINY = np.float32(1e-12)


class PairSimilarity(NamedTuple):
    """Similarity of the candidate pairs of an image set."""

    pairs: Int64
    """Image indices (n, 2) of the candidate pairs, the smaller index first, in ascending order."""
    values: Float64
    """Similarities (n,), 0 or larger for similarities of local features."""


def strongest_descriptors(features: Features) -> Float32:
    """Return the k descriptors (k, d) of largest score, or the first k if there are no scores."""
    if features.scores is None:
        return features.descriptors[:NUM_DESCRIPTORS]
    order = np.argsort(-features.scores, kind="stable")[:NUM_DESCRIPTORS]
    return features.descriptors[order]


def match_score(a: Float32, b: Float32) -> float:
    """Sum ``1 - distance / second distance`` over mutual nearest neighbors.

    Args:
        a: (n, d) descriptors of the first image.
        b: (m, d) descriptors of the second image.
    """
    _, _, ratios = mutual_nearest(a, b)
    return float((1 - ratios).sum())


def candidate_pairs(descriptors: Sequence[Float32], num_candidates: int) -> Int64:
    """Pair each image with the images of most similar global descriptor.

    Args:
        descriptors: Strongest descriptors (k, d) of each image; k may differ and may be 0.
        num_candidates: Number of images that each image is paired with. If there are not more, all
            pairs are candidates.

    Returns:
        Image indices (n, 2), the smaller index first, in ascending order.
    """
    count = len(descriptors)
    if count <= num_candidates + 1:
        return np.stack(np.triu_indices(count, 1), axis=1)
    return rank_images(compute_vlad(descriptors), num_candidates).pairs


def compute_vlad(descriptors: Sequence[Float32]) -> Float32:
    """Aggregate the local descriptors of each image to a global descriptor of unit length.

    Args:
        descriptors: Descriptors (k, d) of each image; images without descriptors get zeros.

    Returns:
        Global descriptors (n, clusters * d).
    """
    rng = np.random.default_rng(0)
    samples_per_image = -(-_TRAINING_DESCRIPTORS // len(descriptors))
    sample = np.concatenate(
        [rng.permutation(found)[:samples_per_image] for found in descriptors if len(found)]
    )
    num_clusters = min(_NUM_CLUSTERS, len(sample))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty", UserWarning)
        centers, _ = kmeans2(sample, num_clusters, minit="points", seed=rng)
    vectors = np.zeros((len(descriptors), *centers.shape), dtype=np.float32)
    for vector, found in zip(vectors, descriptors, strict=True):
        if len(found):
            members = np.eye(num_clusters, dtype=np.float32)[vq(found, centers)[0]].T
            residuals = members @ found - members.sum(axis=1, keepdims=True) * centers
            lengths = np.linalg.norm(residuals, axis=1, keepdims=True)
            vector[:] = residuals / np.sqrt(np.maximum(lengths, _TINY))
    flat = vectors.reshape(len(descriptors), -1)
    flat = np.sign(flat) * np.sqrt(np.abs(flat))
    unit: Float32 = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), _TINY)
    return unit


def rank_images(vectors: Float32 | Float64, count: int) -> PairSimilarity:
    """Pair each image with the ``count`` images of largest dot product of global descriptors.

    Args:
        vectors: Global descriptors (n, d).
        count: Number of most similar images of each image.

    Returns:
        The pairs of all images, each pair once, with dot products as similarity.
    """
    pairs, values = [], []
    for first in range(0, len(vectors), _BLOCK):
        products = vectors[first : first + _BLOCK] @ vectors.T
        rows = np.arange(len(products))[:, None]
        products[rows, first + rows] = -np.inf
        best = np.argsort(-products, axis=1, kind="stable")[:, : min(count, len(vectors) - 1)]
        values.append(products[rows, best].ravel().astype(np.float64))
        images = np.broadcast_to(first + rows, best.shape)
        pairs.append(np.stack([np.minimum(images, best), np.maximum(images, best)], axis=-1))
    found, index = np.unique(np.concatenate(pairs).reshape(-1, 2), axis=0, return_index=True)
    return PairSimilarity(found, np.concatenate(values)[index])


def diffuse_similarity(scores: PairSimilarity, count: int) -> PairSimilarity:
    """Convert match scores to similarities by subtracting chance scores and by diffusion.

    Diffusion for an image is limited to the image and its candidates.

    Args:
        scores: Match scores of the candidate pairs.
        count: Number of images.

    Returns:
        Nonnegative similarities of the candidate pairs.
    """
    (first, second), values = scores.pairs.T, scores.values
    image_scores = np.bincount(first, values, count) + np.bincount(second, values, count)
    by_chance = image_scores[first] * image_scores[second] / max(image_scores.sum(), float(_TINY))
    excess = np.maximum(values - by_chance, 0) / np.sqrt(by_chance + 1)
    excess_sums = np.bincount(first, excess, count) + np.bincount(second, excess, count)
    degree = np.sqrt(np.maximum(excess_sums, float(_TINY)))
    links = _symmetric(scores.pairs, excess / (degree[first] * degree[second]), count)
    candidates = _symmetric(scores.pairs, np.arange(1.0, 1 + len(values)), count)
    diffused = np.zeros(len(values))
    for image, (others, rows) in enumerate(_entries(candidates)):
        members = np.append(others, image)
        system = np.eye(len(members)) - DIFFUSION_RATIO * links[members][:, members].toarray()
        unit = np.eye(len(members))[-1]
        diffused[rows.astype(np.int64) - 1] += np.linalg.solve(system, unit)[:-1] / 2
    return PairSimilarity(scores.pairs, np.maximum(diffused, 0))


def _symmetric(pairs: Int64, values: Float64, count: int) -> csr_array:
    """Return a symmetric sparse matrix (count, count) with the values of the pairs."""
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    return csr_array((np.tile(values, 2), (rows, columns)), shape=(count, count))


def _entries(matrix: csr_array) -> Iterator[tuple[Int64, Float64]]:
    """Yield the columns and values of the stored entries of each row."""
    for start, end in zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True):
        yield matrix.indices[start:end], matrix.data[start:end]
