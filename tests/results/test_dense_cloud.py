"""Fusing refined depth maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior
from mpsfm_core.results.dense_cloud import fuse_depth_maps
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.testing.scenes import project, room_scene


def with_depth(solved, row: int, depth: np.ndarray, variance: np.ndarray | None = None):
    images = list(solved.best.images)
    old = images[row].depth
    variance = old.variance if variance is None else variance
    images[row] = replace(images[row], depth=DepthPrior(depth, variance, depth > 0))
    return replace(solved.best, images=tuple(images))


def test_exact_maps_give_points_on_the_surfaces_in_their_colours(solved) -> None:
    options = ResultOptions()
    points, colors = fuse_depth_maps(solved.best, solved.views.__getitem__, options)
    total = sum(image.depth.valid.sum() for image in solved.best.images)
    assert 0.95 * total < len(points) <= total
    scene = room_scene()
    image = solved.best.images[0]
    pose = np.column_stack([image.rotation, image.translation])
    xy, depth = project(image.camera, pose, points)
    inside = (depth > 0) & (xy > 1).all(1) & (xy < np.array(image.camera.size) - 1).all(1)
    surface = scene.sample(image.camera, pose, xy[inside]).depth
    # In front of the surface there is nothing; behind it, what other images see.
    assert (depth[inside] > surface - 0.02).mean() > 0.999
    first = slice(0, int(image.depth.valid.sum() * 0.9))
    near = (
        solved.views[image.name]
        .image[xy[first, 1].astype(int), xy[first, 0].astype(int)]
        .astype(float)
    )
    assert np.abs(near - colors[first]).mean() < 15


def test_uncertain_pixels_are_left_out(solved) -> None:
    old = solved.best.images[1].depth
    variance = np.full_like(old.variance, 1e-4)
    variance[:30] = (0.2 * old.depth[:30]) ** 2
    uncertain = with_depth(solved, 1, old.depth, variance)
    full, _ = fuse_depth_maps(solved.best, solved.views.__getitem__, ResultOptions())
    fewer, _ = fuse_depth_maps(uncertain, solved.views.__getitem__, ResultOptions())
    lost = len(full) - len(fewer)
    assert 0.9 * old.valid[:30].sum() < lost <= 1.1 * old.valid[:30].sum()


def test_a_network_that_promises_little_gives_a_cloud_too(solved) -> None:
    images = tuple(
        replace(image, depth=replace(old, variance=(0.25 * old.depth) ** 2))
        for image in solved.best.images
        if (old := image.depth)
    )
    vague = replace(solved.best, images=images)
    points, _ = fuse_depth_maps(vague, solved.views.__getitem__, ResultOptions())
    total = sum(image.depth.valid.sum() for image in solved.best.images)
    assert len(points) > 0.95 * total


def test_a_wall_in_free_space_is_left_out(solved) -> None:
    depth = solved.best.images[1].depth.depth.copy()
    depth[20:40, 30:50] = 1.0  # other images see right through
    walled = with_depth(solved, 1, depth)
    points, _ = fuse_depth_maps(walled, solved.views.__getitem__, ResultOptions())
    image = solved.best.images[1]
    z = (points @ image.rotation.T + image.translation)[:, 2]
    assert ((z > 0.99) & (z < 1.01)).sum() < 0.1 * 400


def test_images_that_nothing_confirms_are_left_out(solved) -> None:
    first, second, third = solved.best.images
    guessed = replace(third, confirmed=False, translation=third.translation + 5.0)
    doubtful = replace(solved.best, images=(first, second, guessed))
    without = replace(solved.best, images=(first, second))
    points, _ = fuse_depth_maps(doubtful, solved.views.__getitem__, ResultOptions())
    expected, _ = fuse_depth_maps(without, solved.views.__getitem__, ResultOptions())
    np.testing.assert_array_equal(points, expected)


@pytest.mark.parametrize("limit", [1, 500])
def test_the_size_limit_holds_and_the_choice_is_repeatable(solved, limit: int) -> None:
    options = ResultOptions(dense_max_points=limit)
    points, colors = fuse_depth_maps(solved.best, solved.views.__getitem__, options, seed=3)
    assert len(points) == len(colors) <= limit
    assert len(points) > 0.8 * limit - 1
    again, _ = fuse_depth_maps(solved.best, solved.views.__getitem__, options, seed=3)
    np.testing.assert_array_equal(points, again)
