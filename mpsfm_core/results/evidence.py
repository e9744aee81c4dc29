"""Measure the evidence for a reconstruction: explained matches, parallax and connectivity.

The evidence is written into ``summary.json`` and judged by :mod:`mpsfm_core.report.verdict`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.consistency.misregistration import (
    count_contradictions,
    find_contradicted_cuts,
)
from mpsfm_core.mapping.scene.reconstruction import (
    Reconstruction,
    RegisteredImage,
    find_explained_matches,
)
from mpsfm_core.results.frame_errors import FrameErrors, measure_frame_errors

MIN_CONTRADICTING_MATCHES = 30
"""Minimum number of matches of a pair that can contradict poses [COLMAP
abs_pose_min_num_inliers]."""
MIN_SHARED_POINTS = 15
"""Minimum number of common 3D points of connected parts of a model [COLMAP two-view
min_num_inliers]."""


def count_explained_matches(
    reconstruction: Reconstruction, problem: MappingProblem
) -> dict[tuple[str, str], int]:
    """Count the matches of each registered image pair whose keypoints share a 3D point.

    Pairs of a duplicate and its original are left out, because they have the same pose, and most of
    their matches observe no point of another view.

    Args:
        reconstruction: reconstruction of some images of the mapping problem.
        problem: mapping problem with images and verified pairs.

    Returns:
        Number of explained matches by pair of image names.
    """
    distinct = replace(problem, pairs=problem.distinct_pairs)
    return {
        (problem.images[pair.image_a].name, problem.images[pair.image_b].name): int(mask.sum())
        for pair, mask in find_explained_matches(reconstruction.confirmed_images, distinct)
    }


def describe_evidence(reconstruction: Reconstruction, problem: MappingProblem) -> dict[str, Any]:
    """Describe the evidence for the poses of a reconstruction as plain data.

    The images of a frame of a rig have one pose, so they count as one image: they have the same
    evidence, and only points that several frames observe support their pose. A duplicate has the
    share of explained matches of its original.

    Args:
        reconstruction: reconstruction of some images of the mapping problem.
        problem: mapping problem with images and verified pairs.

    Returns:
        Plain data with the keys ``contradicted_group``, ``parts``, ``median_angle_deg``,
        ``relative_scale_std``, ``depth_disagreement``, ``images`` and ``frames``.
        ``contradicted_group`` are the image names of a group whose matches with the other images
        mostly contradict its poses, and the excess of these matches, or None. ``parts`` are the
        image names of each part of the model, largest part first; parts share few 3D points.
        ``median_angle_deg`` is the median over the 3D points of the maximum triangulation angle.
        ``relative_scale_std`` is the largest relative standard deviation of a distance between two
        frames of rigs without depth priors, or None. ``depth_disagreement`` is the largest
        difference of the depth of two frames of rigs, in standard deviations, or None. ``images``
        are, by image name, the number of 3D points, the share of explained matches, and the
        predicted relative pose errors: that of an uncertain camera, and that of matches alone for
        frames of rigs (None without a prediction). ``frames`` are the image names of each frame
        with several images.
    """
    frames = _group_by_frame(reconstruction, problem)
    frame_of = {image.name: number for number, frame in enumerate(frames) for image in frame}
    explained = count_explained_matches(reconstruction, problem)
    matched = {
        (problem.images[pair.image_a].name, problem.images[pair.image_b].name): len(pair)
        for pair in problem.pairs
    }
    num_matched, num_explained = np.zeros((2, len(frames)), dtype=np.int64)
    for names, count in explained.items():
        for name in names:
            num_matched[frame_of[name]] += matched[names]
            num_explained[frame_of[name]] += count
    for image in problem.images:
        if image.name in frame_of and image.duplicate_of in frame_of:
            frame, original = frame_of[image.name], frame_of[image.duplicate_of]
            num_matched[frame], num_explained[frame] = (
                num_matched[original],
                num_explained[original],
            )
    ratios = num_explained / np.maximum(num_matched, 1)
    num_frames = _count_frames(frames, len(reconstruction.points))
    is_shared = num_frames >= (2 if len(frame_of) > len(frames) else 1)
    errors = _measure_rig_errors(frames, reconstruction.points, problem)
    scale_std = errors.relative_scale_std if errors else None
    match_errors = errors.pose_deg.tolist() if errors else [None] * len(frames)
    return {
        "contradicted_group": _find_contradicted_group(frames, frame_of, matched, explained),
        "parts": _connected_parts(frames, len(reconstruction.points)),
        "median_angle_deg": _median_angle_deg(frames, reconstruction.points, is_shared),
        "relative_scale_std": _round(scale_std, 4),
        "depth_disagreement": _round(errors.depth_disagreement, 2) if errors else None,
        "images": {
            image.name: {
                "points": int(is_shared[_rows(frame)].sum()),
                "explained_ratio": round(float(ratio), 4),
                "pose_error_deg": _round(image.pose_error_deg, 3),
                "match_pose_error_deg": _round(match_error, 3),
            }
            for frame, ratio, match_error in zip(frames, ratios, match_errors, strict=True)
            for image in frame
        },
        "frames": [[image.name for image in frame] for frame in frames if len(frame) > 1],
    }


_Frame = list[RegisteredImage]
_PairNumbers = Mapping[tuple[str, str], int]
"""Number of matches by pair of image names."""


def _find_contradicted_group(
    frames: list[_Frame],
    frame_of: Mapping[str, int],
    num_matched: _PairNumbers,
    num_explained: _PairNumbers,
) -> dict[str, Any] | None:
    """Find the group of images whose matches with the other images contradict its poses most.

    Args:
        frames: images of each frame.
        frame_of: row of the frame of each image by name.
        num_matched: number of matches of the image pairs of the problem.
        num_explained: number of explained matches of the pairs of registered images.

    Returns:
        Names of the images and excess of contradicting matches, or None without such a group.
    """
    sums: dict[tuple[int, int], Int64] = {}
    for names, count in num_explained.items():
        a, b = sorted((frame_of[names[0]], frame_of[names[1]]))
        total = sums.setdefault((a, b), np.zeros(2, np.int64))
        total += num_matched[names], count
    if not sums:
        return None
    pairs = sorted(sums)
    a, b = np.array(pairs, dtype=np.int64).T
    matches, explained = np.array([sums[pair] for pair in pairs]).T
    counts = count_contradictions(a, b, matches, explained, MIN_CONTRADICTING_MATCHES)
    cuts = find_contradicted_cuts(counts, np.ones(len(frames), np.bool_))
    if not cuts:
        return None
    worst = max(cuts, key=lambda cut: cut.margin)
    rows = np.flatnonzero(worst.inside)
    image_names = [image.name for row in rows for image in frames[row]]
    return {"images": image_names, "margin": worst.margin}


def _measure_rig_errors(
    frames: list[_Frame], points: Float64, problem: MappingProblem
) -> FrameErrors | None:
    """Return the errors of frames of rigs that matches alone predict, None for single images."""
    if not any(len(frame) > 1 for frame in frames):
        return None
    return measure_frame_errors(frames, points, problem)


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _group_by_frame(reconstruction: Reconstruction, problem: MappingProblem) -> list[_Frame]:
    """Return the confirmed images of each frame, an image without a rig as its own frame."""
    frame_of = problem.frame_of_images(reconstruction.rigs)
    frames: dict[int, _Frame] = {}
    for image in reconstruction.confirmed_images:
        frames.setdefault(int(frame_of[image.index]), []).append(image)
    return list(frames.values())


def _rows(frame: _Frame) -> Int64:
    """Return the ids of the 3D points that the images of a frame observe."""
    point_ids = np.concatenate([image.point_ids for image in frame])
    return np.unique(point_ids[point_ids >= 0])


def _count_frames(frames: list[_Frame], num_points: int) -> Int64:
    """Return the number of frames (p,) that observe each 3D point."""
    counts = np.zeros(num_points, dtype=np.int64)
    for frame in frames:
        counts[_rows(frame)] += 1
    return counts


def _connected_parts(frames: list[_Frame], num_points: int) -> list[list[str]]:
    """Return the parts of the model that share few 3D points, the largest part first.

    Parts with at least ``MIN_SHARED_POINTS`` common points are merged until no two parts have as
    many.
    """
    if not frames:
        return []
    rows = [_rows(frame) for frame in frames]
    part_of = np.repeat(np.arange(len(frames)), list(map(len, rows)))
    point_ids, labels = np.concatenate(rows), np.arange(len(frames))
    num_parts = 0
    while num_parts != labels.max() + 1:
        num_parts = int(labels.max()) + 1
        shape = num_parts, max(num_points, 1)
        observed = coo_array((np.ones(len(part_of)), (part_of, point_ids)), shape=shape).tocsr() > 0
        shared = observed.astype(np.int64) @ observed.T.astype(np.int64) >= MIN_SHARED_POINTS
        merged = connected_components(shared, directed=False)[1]
        part_of, labels = merged[part_of], merged[labels]
    parts = [
        [
            image.name
            for frame, label in zip(frames, labels, strict=True)
            if label == part
            for image in frame
        ]
        for part in range(labels.max() + 1)
    ]
    return sorted(parts, key=len, reverse=True)


def _median_angle_deg(frames: list[_Frame], points: Float64, is_used: Bool) -> float | None:
    """Return the median over the used 3D points of the maximum triangulation angle in degrees."""
    if not is_used.any() or not frames:
        return None
    mean_rays = np.zeros_like(points)
    rays = []
    for image in (image for frame in frames for image in frame):
        rows = _rows([image])
        ray = points[rows] - camera_center(image.rotation, image.translation)
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        mean_rays[rows] += ray
        rays.append((rows, ray))
    mean_rays /= np.maximum(np.linalg.norm(mean_rays, axis=1, keepdims=True), 1e-12)
    # Twice the largest angle to the mean ray bounds the largest angle between two rays.
    cosines = np.ones(len(points))
    for rows, ray in rays:
        cosines[rows] = np.minimum(cosines[rows], (ray * mean_rays[rows]).sum(axis=1))
    angles = 2 * np.degrees(np.arccos(np.clip(cosines[is_used], -1, 1)))
    return round(float(np.median(angles)), 4)
