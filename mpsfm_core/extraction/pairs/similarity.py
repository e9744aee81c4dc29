"""Image similarity from a few local features, to select image pairs without retrieval.

The match score of two images counts mutual nearest neighbors among their strongest descriptors,
weighted by the ratio of nearest to second nearest distance. The similarity is the match score minus
the score that both images reach by chance, because images with repetitive texture match many
images. Diffusion of the similarities raises the similarity of two images that are both similar to a
third image. Diffusion finds pairs of small overlap (Zhou et al., Ranking on Data Manifolds, NIPS
2003).
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Features, Float32, Float64

NUM_DESCRIPTORS = 512
"""Number of descriptors per image that are compared. The cost of comparison grows with the square
of the number of descriptors. [tuned: benchmarks.pairs]"""
DIFFUSION_RATIO = 0.8
"""Diffusion weight ``alpha`` of manifold ranking. [tuned: benchmarks.pairs]"""
_TINY = np.float32(1e-12)


def strongest_descriptors(features: Features) -> Float32:
    """Return the descriptors (k, d) with the largest scores, or the first k without scores."""
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
    if not len(a) or not len(b):
        return 0.0
    squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T)
    nearest, back = squared.argmin(axis=1), squared.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(a)))
    columns = nearest[rows]
    first = np.maximum(squared[rows, columns], 0)
    squared[rows, columns] = np.inf
    second = np.minimum(squared[rows].min(axis=1), squared[:, columns].min(axis=0))
    return float((1 - np.sqrt(np.minimum(first / np.maximum(second, _TINY), 1))).sum())


def diffuse_similarity(scores: Float64) -> Float64:
    """Convert match scores to similarities by subtracting chance scores and by diffusion.

    Args:
        scores: (n, n) match scores of all pairs, symmetric with zero diagonal.

    Returns:
        (n, n) nonnegative similarities of all images.
    """
    image_scores = scores.sum(axis=1)
    by_chance = np.outer(image_scores, image_scores) / max(image_scores.sum(), float(_TINY))
    excess = np.maximum(scores - by_chance, 0) / np.sqrt(by_chance + 1)
    np.fill_diagonal(excess, 0)
    degree = np.sqrt(np.maximum(excess.sum(axis=1), float(_TINY)))
    links = excess / np.outer(degree, degree)
    diffused: Float64 = np.linalg.inv(np.eye(len(scores)) - DIFFUSION_RATIO * links)
    np.fill_diagonal(diffused, 0)
    similarity: Float64 = np.maximum((diffused + diffused.T) / 2, 0)
    return similarity
