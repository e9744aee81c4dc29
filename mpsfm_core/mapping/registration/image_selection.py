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
            ranked.append((-float(totals[best_frame]), int(owners[best]), int(matching[best])))
    return [(image, best_match) for _, image, best_match in sorted(ranked)]
