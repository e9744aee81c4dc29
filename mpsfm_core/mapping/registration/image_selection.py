"""Selection of the next image to register, and of its reference images."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Bool, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.scene.scene import Scene


def compute_pair_scores(scene: Scene, criterion: str) -> csr_array:
    """Compute the matching score of every two images.

    Args:
        scene: The scene with its verified pairs.
        criterion: Ranking criterion, where "match-scores" sums the match scores and any other value
            counts the matches.

    Returns:
        (n, n) symmetric sparse matrix of float64 matching scores.
    """
    pairs = scene.problem.pairs
    counts = np.array([len(pair) for pair in pairs], dtype=np.float64)
    values = scene.graph.pair_scores if criterion == "match-scores" else counts
    a = np.array([pair.image_a for pair in pairs], dtype=np.int64)
    b = np.array([pair.image_b for pair in pairs], dtype=np.int64)
    ends = np.concatenate([a, b]), np.concatenate([b, a])
    scores = csr_array((np.tile(values, 2), ends), shape=(scene.num_images, scene.num_images))
    scores.sort_indices()
    return scores


def rank_next_images(
    scene: Scene,
    scores: csr_array,
    candidates: Bool,
    options: RegistrationOptions,
) -> list[tuple[int, int]]:
    """Rank the unregistered candidate images, best first (COLMAP's ``FindNextImages``).

    Args:
        scene: The scene with the registered images.
        scores: (n, n) matching scores from :func:`compute_pair_scores`.
        candidates: (n,) bool mask of the images that may be registered.
        options: Registration options, where ``next_view`` selects the ranking criterion.

    Returns:
        Candidate images, best first, each with its best matching registered image.
    """
    visible = _count_visible_points(scene) if options.next_view == "visible-points" else None
    ranked = []
    for image in map(int, np.flatnonzero(candidates & ~scene.registered)):
        row = slice(*scores.indptr[image : image + 2])
        matching, values = scores.indices[row], scores.data[row]
        usable = scene.registered[matching] & (values > 0)
        if usable.any():
            best = int(np.where(usable, values, 0).argmax())
            rank = float(values[best] if visible is None else visible[image])
            ranked.append((-rank, image, int(matching[best])))
    return [(image, best_match) for _, image, best_match in sorted(ranked)]


def _count_visible_points(scene: Scene) -> Int64:
    """Count the keypoints of each image (n,) that match a registered image."""
    graph = scene.graph
    matched = scene.registered[graph.image_of[graph.target]]
    keypoints = np.unique(graph.source[matched])
    return np.bincount(graph.image_of[keypoints], minlength=scene.num_images).astype(np.int64)
