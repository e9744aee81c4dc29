"""Which image comes next, and which registered images it is judged beside."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.scene.scene import Scene


def compute_pair_scores(scene: Scene, criterion: str) -> Float64:
    """(n, n) symmetric float64: how well each two images match, 0 for pairs without matches.

    ``criterion``: "match-scores" sums the matcher's scores, anything else counts matches.
    """
    scores = np.zeros((scene.num_images, scene.num_images))
    for row, pair in enumerate(scene.problem.pairs):
        by_score = criterion == "match-scores"
        score = scene.graph.pair_scores[row] if by_score else float(len(pair))
        scores[pair.image_a, pair.image_b] = scores[pair.image_b, pair.image_a] = score
    return scores


def rank_next_images(
    scene: Scene, scores: Float64, candidates: Bool, options: RegistrationOptions
) -> list[tuple[int, int]]:
    """Unregistered candidates with their best registered image, best first.

    ``scores``: from :func:`compute_pair_scores`. ``candidates``: (n,) bool.
    """
    images = np.flatnonzero(candidates & ~scene.registered)
    registered = scene.registered_images()
    if not len(images) or not len(registered):
        return []
    linked = scores[np.ix_(images, registered)]
    rank = linked.max(axis=1)
    if options.next_view == "visible-points":
        rank = np.where(rank > 0, _visible_points(scene)[images], 0)
    order = [int(k) for k in np.argsort(-rank, kind="stable") if rank[k] > 0]
    return [(int(images[k]), int(registered[linked[k].argmax()])) for k in order]


def find_local_bundle(scene: Scene, image: int, num_neighbors: int, scores: Float64) -> list[int]:
    """The image and the registered images that share most points with it.

    Where fewer than ``num_neighbors`` share any, the best matching ones follow.
    """
    tracks, graph = scene.tracks, scene.graph
    seen = tracks.point_of[graph.keypoints_of(image)]
    seen = seen[seen >= 0]
    observing = np.zeros(len(tracks.xyz), dtype=np.bool_)
    observing[seen] = True
    observed = np.flatnonzero(tracks.point_of >= 0)
    shared = observing[tracks.point_of[observed]]
    counts = np.bincount(graph.image_of[observed[shared]], minlength=scene.num_images)
    order = np.lexsort((-scores[image], -counts))
    usable = scene.registered & ((counts > 0) | (scores[image] > 0))
    usable[image] = False
    neighbors = [int(k) for k in order if usable[k]]
    return [image, *neighbors[:num_neighbors]]


def _visible_points(scene: Scene) -> Int64:
    """(n,) for each image, how many of its keypoints match a registered image."""
    graph = scene.graph
    matched = scene.registered[graph.image_of[graph.target]]
    visible = np.unique(graph.source[matched])
    return np.bincount(graph.image_of[visible], minlength=scene.num_images).astype(np.int64)
