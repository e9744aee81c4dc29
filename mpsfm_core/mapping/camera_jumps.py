"""Detection of jumps of a video camera in a reconstruction, which false matches cause.

Rooms that look alike have verified matches. If the mapper places keyframes of two such rooms in the
same room, the camera jumps somewhere between the rooms, although a camera cannot jump within a
shot. Matches between distant keyframes before and after the jump may then be wrong. A model
without them shows which are right: the places that they join are close to each other there, up to
the drift of the camera between both keyframes. A closed loop can also make the camera jump, where
successive keyframes share few points, but not further than the drift. Matches across such a small
jump remain.

A fast turn looks like a cut in single frames, and then divides a shot in two. Matches between the
keyframes on both sides show that there is no cut.

Usage::

    shots = join_shots(shots, problem)
    jumps = find_jumps(reconstructions, shots)
    shorter = remove_matches_across(problem, jumps, shots)      # then map again
    problem = restore_right_matches(shorter, problem, reconstructions, shots)  # and map again
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, MappingProblem, VerifiedPair
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

Shot = Mapping[str, float]
"""Time stamp in seconds by name of each keyframe of a shot, ascending."""


class Jump(NamedTuple):
    """Two successive registered keyframes of a shot between which the camera jumps."""

    before: str
    """Name of the last keyframe before the jump."""
    after: str
    """Name of the first keyframe after the jump."""
    is_drift: bool = False
    """True if drift can cause a jump of this length, and the camera does not turn too fast."""


MIN_SPEED_RATIO = 4.0
"""Minimum ratio of the speed of a jump to the 90 % quantile of the speed of the camera, for
translation or rotation. [tuned: benchmarks.walks --look-alike]"""
MIN_COMMON_POINTS = 15
"""Number of common points from which two keyframes have no jump in between, and of verified matches
from which they have no cut in between. [COLMAP two-view min_num_inliers]"""
_SPEED_QUANTILE = 0.9
NUM_NEIGHBORS = 10
"""Number of following keyframes with which a keyframe may be matched across a jump.
[COLMAP sequential_matching.overlap]"""
MAX_DRIFT_JUMP = 0.1
"""Maximum distance of a jump that drift may cause, relative to the length of the path of the camera
in the shot. [tuned: benchmarks.walks]"""
MAX_DRIFT = 0.25
"""Maximum median distance of two matched keypoints' 3D points, for a removed pair that is used
again. The distance is relative to the length of the camera path between both keyframes. [tuned:
benchmarks.walks]"""


def join_shots(shots: Sequence[Shot], problem: MappingProblem) -> list[Shot]:
    """Join successive shots of a video if verified matches show no cut between both shots.

    Args:
        shots: Keyframes of all shots in the order of their videos, each video in its own folder.
        problem: Mapping problem with the verified pairs.
    """
    names = [image.name for image in problem.images]
    matched = {
        frozenset((names[pair.image_a], names[pair.image_b]))
        for pair in problem.pairs
        if len(pair) >= MIN_COMMON_POINTS
    }
    joined: list[Shot] = []
    for shot in shots:
        if joined:
            last, first = list(joined[-1])[-1], next(iter(shot))
            is_same_video = PurePosixPath(last).parent == PurePosixPath(first).parent
            if is_same_video and {last, first} in matched:
                joined[-1] = {**joined[-1], **shot}
                continue
        joined.append(shot)
    return joined


def find_jumps(reconstructions: Sequence[Reconstruction], shots: Sequence[Shot]) -> list[Jump]:
    """Find successive keyframes with few common points between which the camera is too fast.

    Args:
        reconstructions: Components of the model.
        shots: Keyframes of all shots.
    """
    return [jump for part in reconstructions for jump in _find_jumps_of_part(part, shots)]


def remove_matches_across(
    problem: MappingProblem, jumps: Sequence[Jump], shots: Sequence[Shot]
) -> MappingProblem:
    """Remove the pairs of distant keyframes that are on both sides of a jump in the same shot.

    Pairs of keyframes with less than :data:`NUM_NEIGHBORS` keyframes in between remain, and all
    pairs across a jump that drift may cause.
    """
    jumps = [jump for jump in jumps if not jump.is_drift]
    if not jumps:
        return problem
    places = {
        name: (number, place)
        for number, shot in enumerate(shots)
        for place, name in enumerate(shot)
    }
    cuts = [(*places[jump.before], places[jump.after][1]) for jump in jumps]

    def is_across(a: str, b: str) -> bool:
        if a not in places or b not in places or places[a][0] != places[b][0]:
            return False
        number = places[a][0]
        first, last = sorted((places[a][1], places[b][1]))
        return last - first > NUM_NEIGHBORS and any(
            number == shot and first <= before and last >= after for shot, before, after in cuts
        )

    names = [image.name for image in problem.images]
    pairs = [p for p in problem.pairs if not is_across(names[p.image_a], names[p.image_b])]
    return replace(problem, pairs=tuple(pairs))


def restore_right_matches(
    shorter: MappingProblem,
    problem: MappingProblem,
    reconstructions: Sequence[Reconstruction],
    shots: Sequence[Shot],
) -> MappingProblem:
    """Use removed pairs again if the model without them confirms their matches.

    The matched keypoints of a pair have two 3D points each, if the model does not know that they
    are the same. The pair is right if their median distance is at most :data:`MAX_DRIFT` of the
    length of the path of the camera between both keyframes.

    Args:
        shorter: Problem without the pairs across jumps.
        problem: Problem with all pairs.
        reconstructions: Components of the model of `shorter`.
        shots: Keyframes of all shots.
    """
    kept = set(shorter.pairs)
    removed = [pair for pair in problem.pairs if pair not in kept]
    if not removed:
        return shorter
    for part in reconstructions:
        images = {image.index: image for image in part.confirmed_images}
        for keyframes in _registered_keyframes(part, shots):
            lengths = np.cumsum([0.0, *_step_lengths(keyframes)])
            length_of = {image.index: x for (image, _), x in zip(keyframes, lengths, strict=True)}
            kept.update(
                pair
                for pair in removed
                if pair.image_a in length_of
                and pair.image_b in length_of
                and _measure_displacement(pair, images, part.points)
                <= MAX_DRIFT * abs(length_of[pair.image_a] - length_of[pair.image_b])
            )
    return replace(problem, pairs=tuple(pair for pair in problem.pairs if pair in kept))


def _measure_displacement(
    pair: VerifiedPair, images: Mapping[int, RegisteredImage], points: Float64
) -> float:
    """Return the median distance of the two 3D points of matched keypoints, in world units.

    It is infinite for less than :data:`MIN_COMMON_POINTS` matches with two points.
    """
    ids = np.stack(
        [
            images[image].point_ids[pair.matches[:, side]]
            for side, image in enumerate((pair.image_a, pair.image_b))
        ]
    )
    first, second = points[ids[:, (ids >= 0).all(axis=0)]]
    if len(first) < MIN_COMMON_POINTS:
        return math.inf
    return float(np.median(np.linalg.norm(first - second, axis=1)))


def _registered_keyframes(
    part: Reconstruction, shots: Sequence[Shot]
) -> Iterator[list[tuple[RegisteredImage, float]]]:
    """Yield the keyframes of each shot in a component, with their time stamps in seconds."""
    images = {image.name: image for image in part.confirmed_images}
    for shot in shots:
        keyframes = [(images[name], time_s) for name, time_s in shot.items() if name in images]
        if keyframes:
            yield keyframes


def _step_lengths(keyframes: Sequence[tuple[RegisteredImage, float]]) -> Float64:
    """Return the distances (n - 1,) between the camera centers of n successive keyframes."""
    centers = np.stack([camera_center(i.rotation, i.translation) for i, _ in keyframes])
    lengths: Float64 = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return lengths


def _find_jumps_of_part(part: Reconstruction, shots: Sequence[Shot]) -> Iterator[Jump]:
    """Yield the jumps in one component."""
    steps: list[tuple[RegisteredImage, RegisteredImage, bool]] = []
    speeds: list[tuple[float, float]] = []
    for keyframes in _registered_keyframes(part, shots):
        lengths = _step_lengths(keyframes)
        is_short = lengths <= MAX_DRIFT_JUMP * lengths.sum()
        for row, ((a, start_s), (b, end_s)) in enumerate(pairwise(keyframes)):
            seconds = end_s - start_s
            turn_deg = rotation_angle_deg(a.rotation @ b.rotation.T)
            steps.append((a, b, bool(is_short[row])))
            speeds.append((float(lengths[row]) / seconds, float(turn_deg) / seconds))
    if not steps:
        return
    limits = MIN_SPEED_RATIO * np.quantile(speeds, _SPEED_QUANTILE, axis=0)
    too_fast = (np.array(speeds) > limits).tolist()
    for (a, b, is_short_step), (moves_fast, turns_fast) in zip(steps, too_fast, strict=True):
        if not (moves_fast or turns_fast):
            continue
        common = np.intersect1d(a.point_ids[a.point_ids >= 0], b.point_ids)
        if len(common) < MIN_COMMON_POINTS:
            yield Jump(a.name, b.name, is_drift=is_short_step and not turns_fast)
