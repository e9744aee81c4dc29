"""Joining of the reconstructions of overlapping parts along a tree.

Two reconstructions are joined if most common images of two of their parts agree with one similarity
transform, and the depth maps of both reconstructions do not contradict each other
(:mod:`~mpsfm_core.mapping.consistency.depth_consistency`). Where a loop of parts closes, common
images at one of both ends disagree because of drift, which the refinement of all parts corrects.

Parts that look alike have the same structure at the common images, but other structure around them.
Matches between both reconstructions are no evidence, because the matches of two places that look
alike support the wrong transform.

Pairs of reconstructions with the most common points are joined first.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, count
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Int64, MappingProblem
from mpsfm_core.mapping.consistency.depth_consistency import (
    DepthConsistencyCheck,
    find_overlapping_images,
)
from mpsfm_core.mapping.consistency.visibility import Views
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.alignment import align_reconstructions, find_agreeing
from mpsfm_core.mapping.refinement.depth_noise import measure_depth_noise
from mpsfm_core.mapping.scene.reconstruction import (
    Reconstruction,
    RegisteredImage,
    transform_reconstruction,
)
from mpsfm_core.mapping.scene.scene import Scene

MAX_CONFLICT_RATIO = 0.25
"""Share of overlapping images with contradicting depth above which a join is refused. [tuned:
benchmarks.scale]"""

MAX_COMPARED_IMAGES = 64
"""Maximum number of images of each reconstruction whose depth is compared for a join, which limits
the time of a join of large reconstructions. [ours]"""
MAX_SAMPLED_POINTS = 4096
"""Maximum number of points by which images with overlapping views are selected. [ours]"""

_log = logging.getLogger(__name__)


class DepthEvidence(NamedTuple):
    """Agreement of the depth maps of two reconstructions."""

    num_overlapping: int
    """Number of compared images of the smaller reconstruction that overlap images of the larger
    one."""
    num_conflicting: int
    """Number of these images whose depth contradicts an image of the larger reconstruction."""

    @property
    def supports_join(self) -> bool:
        """True if the depth of few images contradicts the join."""
        return self.num_conflicting <= MAX_CONFLICT_RATIO * self.num_overlapping


def join_reconstructions(
    problem: MappingProblem, models: Sequence[Reconstruction], options: MapperOptions
) -> list[Reconstruction]:
    """Join the reconstructions of overlapping parts if depth does not contradict the joins.

    Args:
        problem: Mapping problem of all parts.
        models: Reconstructions of the parts, with image indices of ``problem``.
        options: Options of the mapper.

    Returns:
        Joined reconstructions, sorted by decreasing number of images. An image of several joined
        reconstructions remains only in the largest.
    """
    groups = dict(enumerate(models))
    group_of = np.arange(len(models))
    refused: set[tuple[int, int]] = set()
    numbers = count(len(models))
    for row_a, row_b in _rank_joins(models):
        key = int(group_of[row_a]), int(group_of[row_b])
        if key[0] == key[1] or key in refused:
            continue
        joined = _join_groups(problem, groups[key[0]], groups[key[1]], options)
        if joined is None:
            refused |= {key, key[::-1]}
            continue
        number = next(numbers)
        groups[number] = joined
        group_of[np.isin(group_of, key)] = number
    return _remove_repeated_images([groups[number] for number in np.unique(group_of)])


def _join_groups(
    problem: MappingProblem, a: Reconstruction, b: Reconstruction, options: MapperOptions
) -> Reconstruction | None:
    """Align and merge two reconstructions, or return None if depth contradicts the join."""
    a, b = sorted((a, b), key=lambda model: -len(model.images))
    alignment = align_reconstructions(a, b)
    if alignment is None:
        return None
    transform = alignment.a_from_b
    b = transform_reconstruction(
        b, transform.scale, transform.rotation, transform.translation, a.metric
    )
    evidence = _compare_depth(problem, a, b, options)
    _log.debug(
        "join of %d and %d images, of which %d of %d agree: %s",
        len(a.images),
        len(b.images),
        alignment.num_images,
        alignment.num_common_images,
        evidence,
    )
    return merge_reconstructions(a, b) if evidence.supports_join else None


def _compare_depth(
    problem: MappingProblem, a: Reconstruction, b: Reconstruction, options: MapperOptions
) -> DepthEvidence:
    """Count the images of ``b`` whose depth contradicts ``a``, both in the same frame."""
    near_a, near_b = _select_near(a, b), _select_near(b, a)
    if not (options.consistency.enabled and near_a and near_b):
        return DepthEvidence(0, 0)
    joined = merge_reconstructions(a, b)
    scene, row_of = _create_scene(problem, joined, near_a | near_b, options)
    in_a = np.array([row_of[index] for index in sorted(near_a)], dtype=np.int64)
    in_b = [row_of[index] for index in sorted(near_b)]
    return _count_depth_conflicts(scene, in_a, in_b, options)


def merge_reconstructions(a: Reconstruction, b: Reconstruction) -> Reconstruction:
    """Merge two reconstructions in the same frame, with common points of common images.

    A point of ``b`` is identified with the point of ``a`` that the same keypoint observes, if both
    points project close to each other. A common image has pose and depth of the reconstruction in
    which it observes more points.
    """
    images_a, images_b = ({image.index: image for image in model.images} for model in (a, b))
    point_of = np.full(len(b.points), -1, dtype=np.int64)
    is_taken = np.zeros(len(a.points), dtype=np.bool_)
    for index in sorted(images_a.keys() & images_b.keys()):
        ids_a, ids_b = images_a[index].point_ids, images_b[index].point_ids
        seen = (ids_a >= 0) & (ids_b >= 0)
        seen[seen] = find_agreeing(images_a[index], a.points[ids_a[seen]], b.points[ids_b[seen]])
        is_new = (point_of[ids_b[seen]] < 0) & ~is_taken[ids_a[seen]]
        ids_a, ids_b = ids_a[seen][is_new], ids_b[seen][is_new]
        point_of[ids_b], is_taken[ids_a] = ids_a, True
    is_added = point_of < 0
    point_of[is_added] = len(a.points) + np.arange(np.count_nonzero(is_added))
    images = dict(images_a)
    for index, image in images_b.items():
        renumbered = np.where(image.point_ids >= 0, point_of[image.point_ids], -1)
        moved = replace(image, point_ids=renumbered)
        images[index] = _merge_image(images[index], moved) if index in images else moved
    return Reconstruction(
        tuple(images[index] for index in sorted(images)),
        np.concatenate([a.points, b.points[is_added]]),
        np.concatenate([a.errors_px, b.errors_px[is_added]]),
        a.metric,
    )


def _merge_image(a: RegisteredImage, b: RegisteredImage) -> RegisteredImage:
    """Return the registration of an image that observes more points.

    If most keypoints of both registrations observe the same points, the points that only the other
    registration observes are added.
    """
    first, second = sorted((a, b), key=lambda image: -np.count_nonzero(image.point_ids >= 0))
    both = (first.point_ids >= 0) & (second.point_ids >= 0)
    num_equal = np.count_nonzero(first.point_ids[both] == second.point_ids[both])
    if 2 * num_equal <= np.count_nonzero(both):
        return first
    ids = first.point_ids.copy()
    candidates = np.flatnonzero((ids < 0) & (second.point_ids >= 0))
    candidates = candidates[~np.isin(second.point_ids[candidates], ids)]
    ids[candidates] = second.point_ids[candidates]
    return replace(first, point_ids=ids)


def _rank_joins(models: Sequence[Reconstruction]) -> list[tuple[int, int]]:
    """Rank the pairs of parts whose common images mostly agree, most common points first."""
    ranked = []
    images = [{image.index for image in model.images} for model in models]
    for row_a, row_b in combinations(range(len(models)), 2):
        if images[row_a] & images[row_b]:
            alignment = align_reconstructions(models[row_a], models[row_b])
            if alignment is not None and alignment.is_supported:
                ranked.append((-alignment.num_points, row_a, row_b))
    return [(row_a, row_b) for _, row_a, row_b in sorted(ranked)]


def _select_near(model: Reconstruction, other: Reconstruction) -> set[int]:
    """Select the images of a reconstruction that see most points of another reconstruction.

    Points that are much farther from an image, or nearer, than from the images that observe them
    count less. Images of both reconstructions are not selected.
    """
    shared = {image.index for image in other.images}
    images = [image for image in model.images if image.index not in shared]
    depths = np.ones(len(other.points))
    for image in other.images:
        observed = image.point_ids[image.point_ids >= 0]
        depths[observed] = other.points[observed] @ image.rotation[2] + image.translation[2]
    step = max(1, len(other.points) // MAX_SAMPLED_POINTS)
    views = Views.of_cameras(
        np.array([image.index for image in images], dtype=np.int64),
        np.array([image.rotation for image in images]).reshape(-1, 3, 3),
        np.array([image.translation for image in images]).reshape(-1, 3),
        np.array([image.camera.params for image in images]).reshape(-1, 4),
        np.array([image.camera.size for image in images], dtype=np.float64).reshape(-1, 2),
    )
    points, depths = (np.ascontiguousarray(values[::step]) for values in (other.points, depths))
    return set(views.find_best(points, depths, num_best=MAX_COMPARED_IMAGES).tolist())


def _create_scene(
    problem: MappingProblem, joined: Reconstruction, indices: set[int], options: MapperOptions
) -> tuple[Scene, dict[int, int]]:
    """Create a scene of some images of a reconstruction.

    Returns:
        The scene, and the row in the scene of each image index.
    """
    row_of = {index: row for row, index in enumerate(sorted(indices))}
    images = tuple(
        replace(image, index=row_of[image.index])
        for image in joined.images
        if image.index in row_of
    )
    part = problem.subset([image.name for image in images])
    scene = Scene(part, weigh_by_score=options.weigh_by_score)
    scene.resume(replace(joined, images=images), refined_map_width=options.refinement.map_width)
    return scene, row_of


def _count_depth_conflicts(
    scene: Scene, in_a: Int64, in_b: Sequence[int], options: MapperOptions
) -> DepthEvidence:
    """Count images ``in_b`` that overlap images ``in_a``, and those with contradicting depth."""
    consistency = options.consistency
    check = DepthConsistencyCheck(scene, consistency)
    std_factor = max(1.0, measure_depth_noise(scene).multiplier)
    views_a = Views.of_scene(scene, in_a)
    num_overlapping = num_conflicting = 0
    for image in in_b:
        others = find_overlapping_images(scene, image, views_a)
        ratios = [
            check.measure_violation_ratio(
                image, other, std_factor, consistency.max_violations, by_target_area=True
            )
            for other in others
        ]
        num_overlapping += bool(others)
        num_conflicting += max(ratios, default=0.0) > consistency.max_violations
    return DepthEvidence(num_overlapping, num_conflicting)


def _remove_repeated_images(models: Sequence[Reconstruction]) -> list[Reconstruction]:
    """Sort reconstructions by size, and keep each image only in the largest reconstruction."""
    seen: set[int] = set()
    remaining = []
    for model in sorted(models, key=lambda model: -len(model.images)):
        images = tuple(image for image in model.images if image.index not in seen)
        seen |= {image.index for image in images}
        if len(images) >= 2:
            remaining.append(replace(model, images=images))
    return remaining
