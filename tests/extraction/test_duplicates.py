"""Tests that an image that shows the view of another image is only matched with that image."""

from __future__ import annotations

import numpy as np
import pytest

import mpsfm_core as mpsfm
from mpsfm_core.data import Features, Float64
from mpsfm_core.extraction.pairs.duplicates import find_duplicates
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

SIZE = (640, 480)


def make_features(keypoints: Float64) -> Features:
    return Features(keypoints, np.empty((len(keypoints), 0), np.float32))


def random_keypoints(seed: int, count: int = 2000) -> Float64:
    return np.random.default_rng(seed).uniform((0, 0), SIZE, (count, 2))


def edit(keypoints: Float64, seed: int = 9) -> Float64:
    """Keep 60 % of the keypoints, as in a brightened copy, and add others."""
    kept = keypoints[np.random.default_rng(seed).random(len(keypoints)) < 0.6]
    return np.concatenate([kept, random_keypoints(seed, len(keypoints) - len(kept))])


def find(*keypoints: Float64, size: tuple[int, int] = SIZE) -> dict[int, int]:
    sizes = [SIZE, *[size] * (len(keypoints) - 1)]
    return find_duplicates([make_features(xy) for xy in keypoints], sizes)


def test_find_duplicates_of_copies_gives_the_first_image() -> None:
    first, second = random_keypoints(0), random_keypoints(1)
    assert find(first, second, edit(first), first.copy(), edit(second)) == {2: 0, 3: 0, 4: 1}


def test_find_duplicates_of_other_views_is_empty() -> None:
    first = random_keypoints(0)
    assert find(first, random_keypoints(1), first + 3.0) == {}
    assert find(first, first * 0.5, size=(320, 240)) == {}


def test_find_duplicates_ignores_chance_and_few_keypoints() -> None:
    """Dense keypoints share many pixels by chance; a few shared keypoints are no evidence."""
    dense = [random_keypoints(seed, 50_000) for seed in range(2)]
    assert find(*dense) == {}
    few = random_keypoints(0, 10)
    assert find(few, few.copy()) == {}
    assert find(np.empty((0, 2)), np.empty((0, 2))) == {}


@pytest.mark.slow
def test_match_images_matches_a_brightened_copy_with_its_original_only() -> None:
    camera = mpsfm.PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
    views = [room_scene().render(camera, pose).rgb for pose in arc_poses(3, 10.0)]
    bright = np.clip(1.2 * views[1].astype(float) + 10, 0, 255).astype(np.uint8)
    pixels = {"a": views[0], "b": views[1], "c": views[2], "d": bright}
    graph = mpsfm.match_images(
        mpsfm.load_images(pixels, cameras=camera),
        config="sift",
        overrides=["adjustment.enabled=false"],
    )
    assert graph.duplicates == {"d": "b"}
    assert set(graph.verified) == {("a", "b"), ("a", "c"), ("b", "c"), ("b", "d")}
