"""Growing tracks: continue, create, complete and merge, with lifting at low parallax.

The operations are those of COLMAP's incremental triangulator on arrays of edges of the
correspondence graph; where the parallax is low, a point comes from depth instead of rays.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry import triangulation_angle_deg
from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.scene.scene import Scene


def triangulate_image(scene: Scene, image: int, options: TriangulationOptions) -> None:
    """Continue tracks into a newly posed image and create new ones with its neighbours."""
    edges = _registered_edges(scene, image)
    max_error = _angle_error_px(scene, image, options)
    extend_tracks(scene, image, edges, max_error)
    create_tracks(scene, edges, max_error, options)


def complete_and_merge_tracks(
    scene: Scene,
    options: TriangulationOptions,
    *,
    images: list[int] | None = None,
    create: bool = False,
) -> int:
    """Add missing observations to tracks and join tracks of the same point.

    ``images``: where to look, by default all registered ones. ``create``: also try anew the
    matches that have no point (COLMAP's retriangulation). Returns the number of observations
    changed.
    """
    before = scene.tracks.point_of.copy()
    images = list(map(int, scene.registered_images())) if images is None else images
    for image in images:
        edges = _registered_edges(scene, image)
        max_error = options.max_error_px * scene.keypoint_std_px[image]
        extend_tracks(scene, image, edges, max_error)
        if create:
            create_tracks(scene, edges, max_error, options)
    merge_tracks(scene, options, images)
    return int((before != scene.tracks.point_of).sum())


def extend_tracks(
    scene: Scene, image: int, edges: tuple[Int64, Int64], max_error_px: float
) -> None:
    """Let an image's keypoints without a point observe the points of the keypoints they match."""
    tracks = scene.tracks
    source, target = edges
    keep = (tracks.point_of[source] < 0) & (tracks.point_of[target] >= 0)
    keypoints, points = source[keep], tracks.point_of[target[keep]]
    errors, _ = scene.project(keypoints, tracks.xyz[points])
    observed = tracks.point_of[scene.graph.keypoints_of(image)]
    seen = np.zeros(len(tracks.xyz), dtype=np.bool_)
    seen[observed[observed >= 0]] = True
    order = np.flatnonzero((errors <= max_error_px) & ~seen[points])
    order = order[np.lexsort((points[order], errors[order]))]
    order = order[_first_of_each(keypoints[order])]
    order = order[_first_of_each(points[order])]
    tracks.point_of[keypoints[order]] = points[order]


def create_tracks(
    scene: Scene, edges: tuple[Int64, Int64], max_error_px: float, options: TriangulationOptions
) -> None:
    """New points for keypoints of one image from their matches that have no point either.

    Each match of a keypoint is a hypothesis (a triangulated or lifted point); the one that most
    of the keypoint's other matches agree with becomes the point, and they its track.
    """
    tracks = scene.tracks
    source, target = edges
    free = (tracks.point_of[source] < 0) & (tracks.point_of[target] < 0)
    source, target = source[free], target[free]
    points, good = triangulate_or_lift(scene, source, target, max_error_px, options)
    source, target, points = source[good], target[good], points[good]
    if not len(source):
        return
    hypothesis, witness = _pairs_within_groups(source)
    errors, _ = scene.project(target[witness], points[hypothesis])
    agrees = errors <= max_error_px
    support = np.bincount(hypothesis[agrees], minlength=len(source))
    total = np.bincount(hypothesis[agrees], errors[agrees], minlength=len(source))
    order = np.lexsort((total / np.maximum(support, 1), -support, source))
    best = order[_first_of_each(source[order])]
    track_of = np.full(len(source), -1)
    track_of[best] = np.arange(len(best))
    member = agrees & (track_of[hypothesis] >= 0)
    keypoints = np.concatenate([source[best], target[witness[member]]])
    track = np.concatenate([np.arange(len(best)), track_of[hypothesis[member]]])
    tracks.add(points[best], keypoints, track)


def triangulate_or_lift(
    scene: Scene,
    source: Int64,
    target: Int64,
    max_error_px: float,
    options: TriangulationOptions,
) -> tuple[Float64, Bool]:
    """A point for each match: triangulated where the angle allows, else lifted from depth.

    Lifts come from the target if its depth is valid (it is refined longer), else from the
    source. Returns points (m, 3) and where they lie before both cameras within the error.
    """
    image_of = scene.graph.image_of
    centers = scene.centers()
    center_a, center_b = centers[image_of[source]], centers[image_of[target]]
    points = triangulate_midpoints(
        center_a, scene.world_rays(source), center_b, scene.world_rays(target)
    )
    low = ~(triangulation_angle_deg(center_a, center_b, points) >= options.min_angle_deg)
    low |= ~_fits(scene, source, target, points, max_error_px)
    from_source, source_valid = scene.lift(source[low])
    from_target, target_valid = scene.lift(target[low])
    points[low] = np.where(target_valid[:, None], from_target, from_source)
    usable = np.zeros_like(low)
    usable[low] = source_valid | target_valid
    parallax = triangulation_angle_deg(center_a, center_b, points)
    good = _fits(scene, source, target, points, max_error_px) & (~low | usable)
    # a lift is for low parallax; where rays meet at a wide angle but miss, depth must not hide it
    good &= ~low | (parallax < 2 * options.min_angle_deg) | ~np.isfinite(parallax)
    return points, good


def merge_tracks(scene: Scene, options: TriangulationOptions, images: list[int]) -> None:
    """Join points whose keypoints match, where the mean point fits all observations.

    ``images``: one end at least of the matches is in one of them.
    """
    tracks, graph = scene.tracks, scene.graph
    edges = [graph.edges_of(image) for image in images]
    p, q = (
        tracks.point_of[np.concatenate([ends[of_image] for of_image in edges] or [ends[:0]])]
        for ends in (graph.source, graph.target)
    )
    apart = (p >= 0) & (q >= 0) & (p != q)
    low, high = np.minimum(p, q)[apart], np.maximum(p, q)[apart]
    count = len(tracks.xyz)
    candidates = np.stack(np.divmod(np.unique(low * count + high), max(count, 1)), axis=1)
    if not len(candidates):
        return
    lengths = tracks.lengths()
    weights = lengths[candidates].astype(np.float64)
    mean = (tracks.xyz[candidates] * weights[..., None]).sum(axis=1)
    mean /= weights.sum(axis=1, keepdims=True)
    observations = tracks.observations()
    first = np.searchsorted(tracks.point_of[observations], np.arange(len(tracks.xyz)))
    rows, members = _expand(first[candidates.ravel()], lengths[candidates.ravel()])
    candidate, keypoints = rows // 2, observations[members]
    errors, _ = scene.project(keypoints, mean[candidate])
    limit = options.max_error_px * scene.keypoint_std_px[graph.image_of[keypoints]]
    bad = np.bincount(candidate, errors > limit, minlength=len(candidates)) > 0
    places = np.sort(candidate * scene.num_images + graph.image_of[keypoints])
    twice = places[1:][places[1:] == places[:-1]] // scene.num_images
    bad[twice] = True
    candidates, mean = candidates[~bad], mean[~bad]
    both = np.full(2 * len(candidates), False)
    both[_first_of_each(candidates.ravel())] = True
    alone = both.reshape(-1, 2).all(axis=1)
    keep, gone = candidates[alone].T
    tracks.xyz[keep] = mean[alone]
    renumber = np.arange(len(tracks.xyz))
    renumber[gone] = keep
    observed = tracks.point_of >= 0
    tracks.point_of[observed] = renumber[tracks.point_of[observed]]


def lift_low_parallax(scene: Scene, options: TriangulationOptions) -> None:
    """Put points of low triangulation angle onto the most certain depth map that sees them."""
    tracks = scene.tracks
    observations = tracks.observations()
    points = tracks.point_of[observations]
    low = (scene.track_angles_deg() < options.min_angle_deg)[points]
    observations, points = observations[low], points[low]
    lifted, valid = scene.lift(observations)
    log_std = scene.keypoint_log_std[observations]
    order = np.flatnonzero(valid)
    order = order[np.lexsort((log_std[order], points[order]))]
    order = order[_first_of_each(points[order])]
    tracks.xyz[points[order]] = lifted[order]


def _registered_edges(scene: Scene, image: int) -> tuple[Int64, Int64]:
    edges = scene.graph.edges_of(image)
    source, target = scene.graph.source[edges], scene.graph.target[edges]
    registered = scene.registered[scene.graph.image_of[target]]
    return source[registered], target[registered]


def _angle_error_px(scene: Scene, image: int, options: TriangulationOptions) -> float:
    return float(scene.intrinsics[image, 0] * np.tan(np.radians(options.max_angle_error_deg)))


def triangulate_midpoints(
    center_a: Float64, ray_a: Float64, center_b: Float64, ray_b: Float64
) -> Float64:
    """Points halfway between two rays each, (m, 3); NaN for parallel rays."""
    aa, bb = (ray_a * ray_a).sum(axis=1), (ray_b * ray_b).sum(axis=1)
    ab = (ray_a * ray_b).sum(axis=1)
    between = center_b - center_a
    da, db = (ray_a * between).sum(axis=1), (ray_b * between).sum(axis=1)
    determinant = aa * bb - ab * ab
    safe = np.where(determinant > 1e-14 * aa * bb, determinant, np.nan)
    along_a = (bb * da - ab * db) / safe
    along_b = (ab * da - aa * db) / safe
    middle = center_a + along_a[:, None] * ray_a + center_b + along_b[:, None] * ray_b
    points: Float64 = 0.5 * middle
    return points


def _fits(scene: Scene, source: Int64, target: Int64, points: Float64, max_error_px: float) -> Bool:
    fits: Bool = np.asarray(np.isfinite(points).all(axis=1))
    for keypoints in (source, target):
        with np.errstate(invalid="ignore"):
            errors, _ = scene.project(keypoints, points)
            fits &= errors <= max_error_px
    return fits


def _first_of_each(values: Int64) -> Int64:
    """Positions where a value occurs for the first time, ascending."""
    return np.sort(np.unique(values, return_index=True)[1])


def _pairs_within_groups(groups: Int64) -> tuple[Int64, Int64]:
    """All ordered pairs of positions, a position with itself included, of equal sorted value."""
    _, first, counts = np.unique(groups, return_index=True, return_counts=True)
    size, start = np.repeat(counts, counts), np.repeat(first, counts)
    return _expand(start, size)


def _expand(first: Int64, counts: Int64) -> tuple[Int64, Int64]:
    """For rows of ``counts[r]`` items from ``first[r]`` on: row and item of each, flattened."""
    rows = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, first[rows] + within
