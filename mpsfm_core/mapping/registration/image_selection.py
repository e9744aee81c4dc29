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

    One image represents each frame of a rig, the image with the best matching registered image.
    Frames are ranked by the match scores between all images of two frames.

    Args:
        scene: The scene with the registered images.
        scores: (n, n) matching scores from :func:`compute_pair_scores`.
        candidates: (n,) bool mask of the images that may be registered.
        options: Registration options, where ``next_view`` selects the ranking criterion.

    Returns:
        Candidate images, best first, each with its best matching registered image.
    """
    visible = _count_visible_points(scene) if options.next_view == "visible-points" else None
    frame_of, is_candidate = scene.rigs.frame_of, candidates & ~scene.registered
    ranked = []
    for frame in map(int, np.unique(frame_of[is_candidate])):
        images = [k for k in scene.rigs.images_of(frame) if is_candidate[k]]
        rows = [slice(*scores.indptr[k : k + 2]) for k in images]
        owners = np.repeat(images, [row.stop - row.start for row in rows])
        matching, values = (
            np.concatenate([array[row] for row in rows]) for array in (scores.indices, scores.data)
        )
        usable = scene.registered[matching] & (values > 0)
        if usable.any():
            owners, matching, values = owners[usable], matching[usable], values[usable]
            _, frame_rows = np.unique(frame_of[matching], return_inverse=True)
            totals = np.bincount(frame_rows, values)
            best_frame = int(totals.argmax())
            best = int(np.where(frame_rows == best_frame, values, 0).argmax())
            rank = float(totals[best_frame] if visible is None else visible[images].sum())
            ranked.append((-rank, int(owners[best]), int(matching[best])))
    return [(image, best_match) for _, image, best_match in sorted(ranked)]


def _count_visible_points(scene: Scene) -> Int64:
    """Count the keypoints of each image (n,) that match a registered image."""
    graph = scene.graph
    matched = scene.registered[graph.image_of[graph.target]]
    keypoints = np.unique(graph.source[matched])
    return np.bincount(graph.image_of[keypoints], minlength=scene.num_images).astype(np.int64)
