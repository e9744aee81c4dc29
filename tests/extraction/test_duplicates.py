"""Tests that an image that shows the view of another image is only matched with that image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import mpsfm_core as mpsfm
from mpsfm_core.data import UInt8
from mpsfm_core.extraction.duplicates import group_similar, measure_aligned_ratio
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = mpsfm.PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)


def render_views(count: int) -> list[UInt8]:
    return [room_scene().render(CAMERA, pose).rgb for pose in arc_poses(count, 10.0)]


def brighten(image: UInt8) -> UInt8:
    brighter: UInt8 = np.clip(1.2 * image.astype(float) + 10, 0, 255).astype(np.uint8)
    return brighter


def move(image: UInt8, shift_px: float) -> UInt8:
    """Move an image to the right by a shift in pixels."""
    warp = np.array([[1.0, 0.0, shift_px], [0.0, 1.0, 0.0]])
    return np.asarray(cv2.warpAffine(image, warp, image.shape[1::-1]), np.uint8)


def make_thumbnail(image: UInt8) -> UInt8:
    return np.asarray(cv2.resize(image[..., 1], (32, 32), interpolation=cv2.INTER_AREA), np.uint8)


def test_group_similar_pairs_edited_copies_of_the_same_size() -> None:
    first, second, third = render_views(3)
    thumbnails = [make_thumbnail(v) for v in (first, second, brighten(first), third, first)]
    assert group_similar(thumbnails, [(320, 240)] * 5) == [{2: [0], 4: [0, 2]}]
    assert group_similar(thumbnails, [*[(320, 240)] * 4, (640, 480)]) == [{2: [0]}]


def test_group_similar_of_images_without_contrast_is_empty() -> None:
    blank = np.full((32, 32), 90, np.uint8)
    assert group_similar([blank, blank], [(320, 240)] * 2) == []


def test_measure_aligned_ratio_is_high_for_edited_copies_only() -> None:
    first, second = render_views(2)
    assert measure_aligned_ratio(first, brighten(first)) > 0.8
    assert measure_aligned_ratio(first, move(first, 0.3)) > 0.8
    assert measure_aligned_ratio(first, move(first, 2.0)) < 0.1
    assert measure_aligned_ratio(first, second) < 0.1
    assert measure_aligned_ratio(np.zeros_like(first), first) == 0.0


@pytest.mark.slow
def test_match_images_gives_a_brightened_copy_the_keypoints_of_its_original() -> None:
    views = render_views(3)
    pixels = {"a": views[0], "b": views[1], "c": views[2], "d": brighten(views[1])}
    images = mpsfm.load_images(pixels, cameras=CAMERA)
    graph = mpsfm.match_images(images, config="sift", overrides=["adjustment.enabled=false"])
    assert graph.duplicates == {"d": "b"}
    assert set(graph.verified) == {("a", "b"), ("a", "c"), ("b", "c"), ("b", "d")}
    np.testing.assert_array_equal(graph.keypoints["d"], graph.keypoints["b"])
    assert len(graph.verified["b", "d"]) == len(graph.keypoints["b"])
    np.testing.assert_array_equal(graph.features["d"].keypoints, graph.features["b"].keypoints)
