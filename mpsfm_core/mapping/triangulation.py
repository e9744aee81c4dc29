"""Triangulation of tracks, and lifting of 3D points from depth maps.

The operations on tracks are those of COLMAP's ``IncrementalTriangulator`` (``Continue``,
``Create``, ``Complete``, ``Merge``), vectorized over the edges of the correspondence graph. If the
triangulation angle is low, a point is lifted from the depth map instead (paper section 3.2).
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry import camera_center, triangulation_angle_deg
from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.scene.scene import Scene


def triangulate_image(scene: Scene, image: int, options: TriangulationOptions) -> None:
    """Continue tracks into a newly registered image, and create tracks with matched images."""
    edges = _get_registered_edges(scene, image)
    max_error_px = _max_angle_error_px(scene, image, options)
    extend_tracks(scene, image, edges, max_error_px)
    create_tracks(scene, edges, max_error_px, options)


def complete_and_merge_tracks(
    scene: Scene,
    options: TriangulationOptions,
    *,
    images: list[int] | None = None,
    create: bool = False,
) -> int:
    """Add missing observations to tracks, and merge tracks that belong to the same point.

    Args:
        scene: The scene.
        options: Options, where ``max_error_px`` limits the reprojection errors in pixels.
        images: Images whose tracks are completed, by default all registered images.
        create: Also create tracks from matches that observe no 3D point (COLMAP's
            ``Retriangulate``).

    Returns:
        The number of observations that were added or changed.
    """
    before = scene.tracks.point_of.copy()
    images = list(map(int, scene.registered_images())) if images is None else images
    for image in images:
        edges = _get_registered_edges(scene, image)
        max_error_px = options.max_error_px * scene.keypoint_std_px[image]
        extend_tracks(scene, image, edges, max_error_px)
        if create:
            create_tracks(scene, edges, max_error_px, options)
    merge_tracks(scene, options, images)
    return int((before != scene.tracks.point_of).sum())


def extend_tracks(
    scene: Scene, image: int, edges: tuple[Int64, Int64], max_error_px: float
) -> None:
    """Add keypoints that observe no 3D point to the tracks of their matched keypoints.

    Args:
        scene: The scene.
        image: The image.
        edges: Source and target keypoints (e,) of the matches of the image to registered images.
        max_error_px: Largest reprojection error of an added observation, in pixels.
    """
    tracks = scene.tracks
    source, target = edges
    continues = (tracks.point_of[source] < 0) & (tracks.point_of[target] >= 0)
    keypoints, points = source[continues], tracks.point_of[target[continues]]
    errors_px, _ = scene.project(keypoints, tracks.xyz[points])
    observed = tracks.point_of[scene.graph.keypoints_of(image)]
    order = np.flatnonzero((errors_px <= max_error_px) & ~np.isin(points, observed))
    order = order[np.lexsort((points[order], errors_px[order]))]
    order = order[_first_occurrences(keypoints[order])]
    order = order[_first_occurrences(points[order])]
    tracks.point_of[keypoints[order]] = points[order]


def create_tracks(
    scene: Scene, edges: tuple[Int64, Int64], max_error_px: float, options: TriangulationOptions
) -> None:
    """Create tracks for keypoints of one image from matches that observe no 3D point.

    Each match of a keypoint gives one point hypothesis, triangulated or lifted from depth. The
    hypothesis that most matches of the keypoint support becomes the point, and its inliers become
    the track.

    Args:
        scene: The scene.
        edges: Source and target keypoints (e,) of the matches of the image to registered images.
        max_error_px: Largest reprojection error of an inlier, in pixels.
        options: Options with the angle limits for triangulation and for lifting.
    """
    tracks = scene.tracks
    source, target = edges
    is_free = (tracks.point_of[source] < 0) & (tracks.point_of[target] < 0)
    source, target = source[is_free], target[is_free]
    points, valid = triangulate_or_lift(scene, source, target, max_error_px, options)
    source, target, points = source[valid], target[valid], points[valid]
    if not len(source):
        return
    hypothesis, match = _pairs_within_groups(source)
    errors_px, _ = scene.project(target[match], points[hypothesis])
    inlier = errors_px <= max_error_px
    support = np.bincount(hypothesis[inlier], minlength=len(source))
    error_sum = np.bincount(hypothesis[inlier], errors_px[inlier], minlength=len(source))
    order = np.lexsort((error_sum / np.maximum(support, 1), -support, source))
    best = order[_first_occurrences(source[order])]
    track_of = np.full(len(source), -1)
    track_of[best] = np.arange(len(best))
    member = inlier & (track_of[hypothesis] >= 0)
    keypoints = np.concatenate([source[best], target[match[member]]])
    track = np.concatenate([np.arange(len(best)), track_of[hypothesis[member]]])
    tracks.add(points[best], keypoints, track)


def triangulate_or_lift(
    scene: Scene,
    source: Int64,
    target: Int64,
    max_error_px: float,
    options: TriangulationOptions,
) -> tuple[Float64, Bool]:
    """Triangulate a point for each match, or lift it from depth if the angle is low.

    A point is lifted from the depth map of the target image if its depth is valid there, because
    the depth map of the target image has been refined more often. If the depth in the target image
    is not valid, the point is lifted from the source image.

    Args:
        scene: The scene.
        source: (m,) keypoints.
        target: (m,) target keypoints that match the source keypoints.
        max_error_px: Largest reprojection error of a point in both images, in pixels.
        options: The option ``min_angle_deg`` is the triangulation angle below which points are
            lifted from depth.

    Returns:
        Points (m, 3) in the world frame, and a mask (m,) of points in front of both cameras with
        small reprojection errors.
    """
    images_a, images_b = scene.graph.image_of[source], scene.graph.image_of[target]
    center_a = camera_center(scene.rotations[images_a], scene.translations[images_a])
    center_b = camera_center(scene.rotations[images_b], scene.translations[images_b])
    ray_a, ray_b = scene.world_rays(source), scene.world_rays(target)
    points = triangulate_midpoints(center_a, ray_a, center_b, ray_b)
    valid = triangulation_angle_deg(center_a, center_b, points) >= options.min_angle_deg
    valid &= _reprojects(scene, source, target, points, max_error_px)
    lifts = np.flatnonzero(~valid)
    source, target = source[lifts], target[lifts]
    from_source, source_valid = scene.lift(source)
    from_target, target_valid = scene.lift(target)
    lifted = np.where(target_valid[:, None], from_target, from_source)
    angle_deg = triangulation_angle_deg(center_a[lifts], center_b[lifts], lifted)
    # A point lifted from depth must not replace the point of two rays that miss each other at a
    # wide angle.
    is_narrow = (angle_deg < 2 * options.min_angle_deg) | ~np.isfinite(angle_deg)
    reprojects = _reprojects(scene, source, target, lifted, max_error_px)
    valid[lifts] = reprojects & is_narrow & (source_valid | target_valid)
    points[lifts] = lifted
    return points, valid


def merge_tracks(scene: Scene, options: TriangulationOptions, images: list[int]) -> None:
    """Merge the 3D points of matched keypoints if the mean point fits all their observations.

    Merging is repeated until no two matched points can be merged.

    Args:
        scene: The scene.
        options: Options, where ``max_error_px`` limits the reprojection errors in pixels.
        images: Images whose matched points are merged.
    """
    graph = scene.graph
    edges = [graph.edges_of(image) for image in images]
    source, target = (
        np.concatenate([ends[of_image] for of_image in edges] or [ends[:0]])
        for ends in (graph.source, graph.target)
    )
    is_open = np.ones(len(scene.tracks.xyz), dtype=np.bool_)
    while is_open.any():
        is_open = _merge_disjoint_pairs(scene, options, source, target, is_open)


def _merge_disjoint_pairs(
    scene: Scene, options: TriangulationOptions, source: Int64, target: Int64, is_open: Bool
) -> Bool:
    """Merge 3D points whose keypoints match, each point with at most one other point.

    Args:
        scene: The scene.
        options: Options of triangulation.
        source: (m,) keypoints of the first images of the matches.
        target: (m,) keypoints of the second images of the matches.
        is_open: Mask of the points of the scene; only pairs with one or two of them are merged.

    Returns:
        Mask of the merged points, and of the points of pairs that remain to be merged. Without
        these points, no further pair can be merged.
    """
    tracks, graph = scene.tracks, scene.graph
    p, q = tracks.point_of[source], tracks.point_of[target]
    differ = (p >= 0) & (q >= 0) & (p != q) & (is_open[p] | is_open[q])
    is_open = np.zeros(len(is_open), dtype=np.bool_)
    low, high = np.minimum(p, q)[differ], np.maximum(p, q)[differ]
    num_points = len(tracks.xyz)
    keys = np.unique(low * num_points + high)
    candidates = np.stack(np.divmod(keys, max(num_points, 1)), axis=1)
    if not len(candidates):
        return is_open
    points, rows_of_candidates = np.unique(candidates, return_inverse=True)
    rows_of_candidates = rows_of_candidates.reshape(candidates.shape)
    observations, observed_rows = tracks.observations_of(points)
    lengths = np.bincount(observed_rows, minlength=len(points))
    weights = lengths[rows_of_candidates].astype(np.float64)
    mean = (tracks.xyz[candidates] * weights[..., None]).sum(axis=1)
    mean /= weights.sum(axis=1, keepdims=True)
    first = np.cumsum(lengths) - lengths
    rows, members = _expand_ranges(
        first[rows_of_candidates.ravel()], lengths[rows_of_candidates.ravel()]
    )
    candidate, keypoints = rows // 2, observations[members]
    errors_px, _ = scene.project(keypoints, mean[candidate])
    limit_px = options.max_error_px * scene.keypoint_std_px[graph.image_of[keypoints]]
    rejected = np.bincount(candidate, errors_px > limit_px, minlength=len(candidates)) > 0
    candidate_images = np.sort(candidate * scene.num_images + graph.image_of[keypoints])
    is_repeated = candidate_images[1:] == candidate_images[:-1]
    rejected[candidate_images[1:][is_repeated] // scene.num_images] = True
    candidates, mean = candidates[~rejected], mean[~rejected]
    is_first = np.full(2 * len(candidates), False)
    is_first[_first_occurrences(candidates.ravel())] = True
    is_disjoint = is_first.reshape(-1, 2).all(axis=1)
    remaining, merged = candidates[is_disjoint].T
    tracks.xyz[remaining] = mean[is_disjoint]
    keypoints, rows = tracks.observations_of(merged)
    tracks.point_of[keypoints] = remaining[rows]
    is_open[remaining] = is_open[candidates[~is_disjoint]] = True
    return is_open


def lift_low_parallax(scene: Scene, options: TriangulationOptions) -> None:
    """Replace points of low parallax by points lifted from the most certain depth map."""
    tracks = scene.tracks
    observations = tracks.observations()
    points = tracks.point_of[observations]
    is_low = (scene.track_angles_deg() < options.min_angle_deg)[points]
    observations, points = observations[is_low], points[is_low]
    lifted, valid = scene.lift(observations)
    log_std = scene.keypoint_log_std[observations]
    order = np.flatnonzero(valid)
    order = order[np.lexsort((log_std[order], points[order]))]
    order = order[_first_occurrences(points[order])]
    tracks.xyz[points[order]] = lifted[order]


def triangulate_midpoints(
    center_a: Float64, ray_a: Float64, center_b: Float64, ray_b: Float64
) -> Float64:
    """Triangulate by the midpoint method (Hartley and Sturm 1997).

    Args:
        center_a: (3,) or (m, 3) centers of the first cameras.
        ray_a: (m, 3) ray directions of the first cameras, not necessarily of unit length.
        center_b: (3,) or (m, 3) centers of the second cameras.
        ray_b: (m, 3) ray directions of the second cameras, in the same frame.

    Returns:
        (m, 3) midpoints between the closest points of both rays, with NaN for parallel rays.
    """
    aa, bb = (ray_a * ray_a).sum(axis=1), (ray_b * ray_b).sum(axis=1)
    ab = (ray_a * ray_b).sum(axis=1)
    baseline = center_b - center_a
    da, db = (ray_a * baseline).sum(axis=1), (ray_b * baseline).sum(axis=1)
    determinant = aa * bb - ab * ab
    nonzero = np.where(determinant > 1e-14 * aa * bb, determinant, np.nan)
    distance_a = (bb * da - ab * db) / nonzero
    distance_b = (ab * da - aa * db) / nonzero
    point_sum = center_a + distance_a[:, None] * ray_a + center_b + distance_b[:, None] * ray_b
    points: Float64 = 0.5 * point_sum
    return points


def _get_registered_edges(scene: Scene, image: int) -> tuple[Int64, Int64]:
    """Return source and target keypoints of the matches of an image to registered images."""
    edges = scene.graph.edges_of(image)
    source, target = scene.graph.source[edges], scene.graph.target[edges]
    registered = scene.registered[scene.graph.image_of[target]]
    return source[registered], target[registered]


def _max_angle_error_px(scene: Scene, image: int, options: TriangulationOptions) -> float:
    """Convert ``max_angle_error_deg`` to a distance from the principal point in pixels."""
    return float(scene.intrinsics[image, 0] * np.tan(np.radians(options.max_angle_error_deg)))


def _reprojects(
    scene: Scene, source: Int64, target: Int64, points: Float64, max_error_px: float
) -> Bool:
    """Return a mask (m,) of the points that project close to both matched keypoints."""
    valid: Bool = np.asarray(np.isfinite(points).all(axis=1))
    for keypoints in (source, target):
        with np.errstate(invalid="ignore"):
            errors_px, _ = scene.project(keypoints, points)
            valid &= errors_px <= max_error_px
    return valid


def _first_occurrences(values: Int64) -> Int64:
    """Return the ascending array positions at which each value occurs for the first time."""
    return np.sort(np.unique(values, return_index=True)[1])


def _pairs_within_groups(groups: Int64) -> tuple[Int64, Int64]:
    """Return all ordered pairs of array positions with equal values, including equal positions.

    Args:
        groups: (m,) sorted values.
    """
    _, first, counts = np.unique(groups, return_index=True, return_counts=True)
    size, start = np.repeat(counts, counts), np.repeat(first, counts)
    return _expand_ranges(start, size)


def _expand_ranges(first: Int64, counts: Int64) -> tuple[Int64, Int64]:
    """Expand ranges ``first[r] .. first[r] + counts[r] - 1`` to arrays of rows ``r`` and items."""
    rows = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, first[rows] + within
