"""Which photos are likely to show the same, told from a few of their features.

Three steps. *Evidence*: mutual nearest neighbours among the strongest_descriptors
descriptors, each weighted by how much nearer it is than the second nearest. *Excess*: a photo of
bushes finds neighbours everywhere, so what two photos find by chance is taken off. *Likeness*:
photos that are both like a third are like each other, which finds pairs with little in common.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Features, Float32, Float64

NUM_DESCRIPTORS = 512
"""Descriptors of each photo. (Ours: of the pairs of rendered_kitchen with more than 0.25 overlap
512 find 99.3 % and 1024, at four times the cost, 99.8 %.)"""
DIFFUSION_RATIO = 0.8
"""Share of its diffuse_similarity that a photo hands on to those like it (ours: 0.9 finds as many);
the method is Zhou et al., Ranking on Data Manifolds, NIPS 2003."""
_TINY = np.float32(1e-12)


def strongest_descriptors(features: Features) -> Float32:
    """Descriptors (k, d) with the largest scores, the first where there are no scores."""
    if features.scores is None:
        return features.descriptors[:NUM_DESCRIPTORS]
    order = np.argsort(-features.scores, kind="stable")[:NUM_DESCRIPTORS]
    return features.descriptors[order]


def match_score(a: Float32, b: Float32) -> float:
    """Number of mutual nearest neighbours of descriptors (n, d) and (m, d), each counted as
    1 less the ratio of its distance to the second smallest of either side."""
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


def diffuse_similarity(found: Float64) -> Float64:
    """How likely photos are to show the same, (n, n), larger is likelier and 0 is not at all.

    ``found``: match_score of each pair, (n, n), symmetric with a zero diagonal.
    """
    of_photo = found.sum(axis=1)
    by_chance = np.outer(of_photo, of_photo) / max(of_photo.sum(), float(_TINY))
    excess = np.maximum(found - by_chance, 0) / np.sqrt(by_chance + 1)
    np.fill_diagonal(excess, 0)
    degree = np.sqrt(np.maximum(excess.sum(axis=1), float(_TINY)))
    links = excess / np.outer(degree, degree)
    handed_on: Float64 = np.linalg.inv(np.eye(len(found)) - DIFFUSION_RATIO * links)
    np.fill_diagonal(handed_on, 0)
    alike: Float64 = np.maximum((handed_on + handed_on.T) / 2, 0)
    return alike
