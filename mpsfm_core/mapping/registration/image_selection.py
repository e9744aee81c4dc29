"""Selection of the next image to register, and of its reference images."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Bool
from mpsfm_core.mapping.scene.scene import Scene


def compute_pair_scores(scene: Scene) -> csr_array:
    """Sum the match scores of each image pair in a symmetric sparse matrix (n, n)."""
    pairs = scene.problem.pairs
    a = np.array([pair.image_a for pair in pairs], dtype=np.int64)
    b = np.array([pair.image_b for pair in pairs], dtype=np.int64)
    values, shape = np.tile(scene.graph.pair_scores, 2), (scene.num_images, scene.num_images)
    scores = csr_array((values, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=shape)
    scores.sort_indices()
    return scores


def rank_next_images(scene: Scene, scores: csr_array, candidates: Bool) -> list[tuple[int, int]]:
    """Rank the unregistered candidate images, best first (COLMAP's ``FindNextImages``).

    One image represents each frame of a rig, the image with the best matching registered image.
    Frames are ranked by the match scores between all images of two frames.

    Args:
        scene: The scene with the registered images.
        scores: (n, n) matching scores from :func:`compute_pair_scores`.
        candidates: (n,) bool mask of the images that may be registered.

    Returns:
        Candidate images, best first, each with its best matching registered image.
    """
    frame_of = scene.rigs.frame_of
    is_candidate = candidates & ~scene.registered
    owners = np.repeat(np.arange(len(frame_of)), np.diff(scores.indptr))
    usable = is_candidate[owners] & scene.registered[scores.indices] & (scores.data > 0)
    owners, matching, values = owners[usable], scores.indices[usable], scores.data[usable]
    frames = frame_of[owners]
    keys = frames * len(frame_of) + frame_of[matching]
    _, frame_pairs = np.unique(keys, return_inverse=True)
    totals = np.bincount(frame_pairs, values)[frame_pairs]
    order = np.lexsort((-values, keys, -totals, frames))
    best = order[np.unique(frames[order], return_index=True)[1]]
    ranked = best[np.lexsort((matching[best], owners[best], -totals[best]))]
    return [(int(owners[k]), int(matching[k])) for k in ranked]
