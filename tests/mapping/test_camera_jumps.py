"""Tests of jumps of the camera of a video in a reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import (
    DepthPrior,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    VerifiedPair,
)
from mpsfm_core.mapping.camera_jumps import (
    MAX_DRIFT,
    MAX_DRIFT_JUMP,
    Jump,
    find_jumps,
    join_shots,
    remove_matches_across,
    restore_right_matches,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 32.0, 24.0)
DEPTH = DepthPrior.from_arrays(np.ones((6, 8), np.float32), np.ones((6, 8), np.float32))
NAMES = [f"frame_{number:06d}.jpg" for number in range(0, 90, 3)]
SHOT = {name: 0.1 * row for row, name in enumerate(NAMES)}
TURN = np.diag([-1.0, 1.0, -1.0])
"""Rotation by 180 degrees about the vertical axis."""


def build_walk(centers: Float64, turned: slice = slice(0), num_common: int = 0) -> Reconstruction:
    """Return keyframes with the camera centers (n, 3), of which successive ones share 20 points.

    Args:
        centers: Camera centers.
        turned: Keyframes that look backward.
        num_common: Number of points that the first turned keyframe shares with the keyframe before.
    """
    images = []
    is_turned = np.zeros(len(centers), np.bool_)
    is_turned[turned] = True
    for row, (center, backward) in enumerate(zip(centers, is_turned, strict=True)):
        points = np.arange(20 * row, 20 * row + 40)
        if backward and not is_turned[row - 1]:
            points[num_common:20] = -1
        rotation = TURN if backward else np.eye(3)
        images.append(
            RegisteredImage(
                row, NAMES[row], CAMERA, rotation, -rotation @ center, points, DEPTH, 1.0
            )
        )
    return Reconstruction(tuple(images), np.zeros((700, 3)), np.zeros(700))


def walk(step: float = 0.1) -> Float64:
    """Return the camera centers of a camera that moves straight on."""
    return step * np.arange(len(NAMES))[:, None] * np.array([0.0, 0.0, 1.0])


def test_steady_walk_has_no_jump() -> None:
    assert find_jumps([build_walk(walk())], [SHOT]) == []
    assert find_jumps([build_walk(walk())], []) == []


def test_find_jumps_returns_the_keyframes_around_a_jump() -> None:
    centers = walk()
    centers[20:] *= -1
    part = build_walk(centers, slice(20, None))
    assert find_jumps([part], [SHOT]) == [Jump(NAMES[19], NAMES[20])]


@pytest.mark.parametrize(("factor", "turned"), [(0.9, False), (1.1, False), (0.9, True)])
def test_small_jump_without_a_turn_is_drift(factor: float, turned: bool) -> None:
    """Within 20 ms, the camera moves by the given factor times the largest drift."""
    centers = walk()
    ratio = factor * MAX_DRIFT_JUMP
    centers[20:, 2] += ratio / (1 - ratio) * 0.1 * (len(NAMES) - 2) - 0.1
    shot = {name: time_s - 0.08 * (row >= 20) for row, (name, time_s) in enumerate(SHOT.items())}
    part = build_walk(centers, slice(20, None))
    if not turned:
        images = (
            replace(image, rotation=np.eye(3), translation=-center)
            for image, center in zip(part.images, centers, strict=True)
        )
        part = replace(part, images=tuple(images))
    is_drift = factor < 1 and not turned
    jumps = find_jumps([part], [shot])
    assert jumps == [Jump(NAMES[19], NAMES[20], is_drift)]
    assert len(remove_matches_across(build_problem([(5, 25)]), jumps, [shot]).pairs) == is_drift


@pytest.mark.parametrize(("num_common", "jumps"), [(0, 1), (14, 1), (15, 0)])
def test_turn_on_the_spot_is_a_jump_with_few_common_points(num_common: int, jumps: int) -> None:
    part = build_walk(walk(), slice(20, None), num_common)
    assert find_jumps([part], [SHOT]) == [Jump(NAMES[19], NAMES[20])] * jumps


def test_jump_at_a_cut_is_allowed() -> None:
    shots = [dict(list(SHOT.items())[:20]), dict(list(SHOT.items())[20:])]
    assert find_jumps([build_walk(walk(), slice(20, None))], shots) == []


def build_problem(ends: list[tuple[int, int]], num_matches: int = 0) -> MappingProblem:
    """Return a problem with the pairs of all keyframes and of one photo, the last image."""
    normals = np.zeros((6, 8, 3), np.float32)
    normals[..., 2] = -1
    flat = NormalPrior.from_arrays(normals, np.ones((6, 8), np.float32))
    names = [*NAMES, "a.jpg"]
    keypoints = np.zeros((num_matches, 2))
    images = tuple(MappingImage(name, CAMERA, keypoints, DEPTH, flat) for name in names)
    matches = np.tile(np.arange(num_matches)[:, None], 2)
    scores, direction = np.ones(num_matches, np.float32), np.array([1.0, 0, 0])
    pairs = tuple(VerifiedPair(a, b, matches, scores, np.eye(3), direction) for a, b in ends)
    return MappingProblem(images, pairs)


@pytest.mark.parametrize(
    ("ends", "num_matches", "num_shots"), [((9, 10), 15, 1), ((9, 10), 14, 2), ((8, 10), 15, 2)]
)
def test_shots_are_joined_if_their_adjoining_keyframes_match(
    ends: tuple[int, int], num_matches: int, num_shots: int
) -> None:
    shots = [dict(list(SHOT.items())[:10]), dict(list(SHOT.items())[10:])]
    joined = join_shots(shots, build_problem([ends], num_matches))
    assert len(joined) == num_shots
    assert {name: time_s for shot in joined for name, time_s in shot.items()} == SHOT


def test_shots_of_two_videos_are_not_joined() -> None:
    shots = [{f"{folder}/{NAMES[row]}": 0.1 * row} for row, folder in enumerate("ab")]
    problem = build_problem([(0, 1)], 30)
    names = [name for shot in shots for name in shot]
    renamed = tuple(
        replace(image, name=name) for image, name in zip(problem.images, names, strict=False)
    )
    assert join_shots(shots, replace(problem, images=renamed)) == shots


def test_remove_matches_across_keeps_neighbors_and_pairs_on_one_side() -> None:
    ends = [(0, 12), (15, 22), (5, 25), (19, 20), (21, 29), (9, 20), (8, 20), (0, 30)]
    problem = build_problem(ends)
    kept = remove_matches_across(problem, [Jump(NAMES[19], NAMES[20])], [SHOT])
    assert [(p.image_a, p.image_b) for p in kept.pairs] == [
        end for end in ends if end not in [(5, 25), (9, 20), (8, 20)]
    ]
    assert len(remove_matches_across(problem, [], [SHOT]).pairs) == len(ends)


def restore_pair_of_loop(offset: float, num_matches: int, num_shots: int = 1) -> int:
    """Return the number of restored pairs of keyframes 0 and 20, between which the path is 2.

    Args:
        offset: Distance of the places that both keyframes see.
        num_matches: Number of matches of the pair.
        num_shots: Number of shots with equal numbers of keyframes.
    """
    part = build_walk(walk())
    points = part.points.copy()
    points[part.images[20].point_ids, 0] = offset
    part = replace(part, points=points)
    pair = build_problem([(0, 20)], num_matches).pairs[0]
    keypoints = np.zeros((40, 2))
    problem = build_problem([(0, 1)])
    images = tuple(replace(image, keypoints=keypoints) for image in problem.images)
    complete = replace(problem, images=images, pairs=(*problem.pairs, pair))
    length = len(NAMES) // num_shots
    shots = [dict(list(SHOT.items())[i : i + length]) for i in range(0, len(NAMES), length)]
    restored = restore_right_matches(
        replace(complete, pairs=problem.pairs), complete, [part], shots
    )
    assert restored.pairs[0] is problem.pairs[0]
    return len(restored.pairs) - 1


@pytest.mark.parametrize(("drift", "num_restored"), [(0.9 * MAX_DRIFT, 1), (1.1 * MAX_DRIFT, 0)])
def test_pairs_whose_places_agree_up_to_drift_are_restored(drift: float, num_restored: int) -> None:
    assert restore_pair_of_loop(2.0 * drift, 15) == num_restored


def test_pairs_that_the_model_does_not_confirm_are_not_restored() -> None:
    assert restore_pair_of_loop(0.0, 14) == 0
    assert restore_pair_of_loop(0.0, 15, num_shots=2) == 0
