"""Selection of the next image to register, and of its reference images."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.scene.scene import Scene


def compute_pair_scores(scene: Scene, criterion: str) -> Float64:
    """Compute the matching score of every two images.

    Args:
        scene: The scene with its verified pairs.
        criterion: Ranking criterion, where "match-scores" sums the match scores and any other value
            counts the matches.

    Returns:
        (n, n) symmetric float64 matching scores, 0 for images without verified matches.
    """
    scores = np.zeros((scene.num_images, scene.num_images))
    for row, pair in enumerate(scene.problem.pairs):
        use_match_scores = criterion == "match-scores"
        score = scene.graph.pair_scores[row] if use_match_scores else float(len(pair))
        scores[pair.image_a, pair.image_b] = scores[pair.image_b, pair.image_a] = score
    return scores


def rank_next_images(
    scene: Scene, scores: Float64, candidates: Bool, options: RegistrationOptions
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
    images = np.flatnonzero(candidates & ~scene.registered)
    registered = scene.registered_images()
    if not len(images) or not len(registered):
        return []
    pair_scores = scores[np.ix_(images, registered)]
    rank = pair_scores.max(axis=1)
    if options.next_view == "visible-points":
        rank = np.where(rank > 0, _count_visible_points(scene)[images], 0)
    order = [int(k) for k in np.argsort(-rank, kind="stable") if rank[k] > 0]
    return [(int(images[k]), int(registered[pair_scores[k].argmax()])) for k in order]


def _count_visible_points(scene: Scene) -> Int64:
    """Count the keypoints of each image (n,) that match a registered image."""
    graph = scene.graph
    matched = scene.registered[graph.image_of[graph.target]]
    keypoints = np.unique(graph.source[matched])
    return np.bincount(graph.image_of[keypoints], minlength=scene.num_images).astype(np.int64)
