"""Tests of fusing refined depth maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mpsfm_core.data import DepthPrior
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.geometry import camera_center, pixel_centers, unproject
from mpsfm_core.testing.synthetic.scenes import project, room_scene


def with_depth(solved, row: int, depth: np.ndarray, variance: np.ndarray | None = None):
    images = list(solved.best.images)
    old = images[row].depth
    variance = old.variance if variance is None else variance
    images[row] = replace(images[row], depth=DepthPrior(depth, variance, depth > 0))
    return replace(solved.best, images=tuple(images))


def lifted(image) -> np.ndarray:
    """Return the world points of all valid pixels of a depth map."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    xy = pixel_centers(width, height)[image.depth.valid]
    local = unproject(camera, xy, image.depth.depth[image.depth.valid])
    return (local - image.translation) @ image.rotation


def assert_covers_every_map(solved, points: np.ndarray) -> None:
    tree = cKDTree(points)
    for image in solved.best.images:
        distance, _ = tree.query(lifted(image))
        assert (distance < 0.08).mean() > 0.95


def test_surface_seen_by_several_images_is_fused_once(solved) -> None:
    cloud = fuse_depth_maps(solved.best, solved.views.__getitem__)
    total = sum(image.depth.valid.sum() for image in solved.best.images)
    assert 0.3 * total < len(cloud.points) < 0.7 * total
    first = solved.best.images[0]
    alone = replace(solved.best, images=(first,))
    single = fuse_depth_maps(alone, solved.views.__getitem__)
    assert len(single.points) == first.depth.valid.sum()
    assert (single.views == 1).all() and cloud.views.max() == len(solved.best.images)
    np.testing.assert_allclose(single.std, 0.01, rtol=1e-4)


def test_normals_face_the_camera_that_saw_the_point(solved) -> None:
    first = solved.best.images[0]
    alone = replace(solved.best, images=(first,))
    cloud = fuse_depth_maps(alone, solved.views.__getitem__)
    length = np.linalg.norm(cloud.normals, axis=1)
    assert (np.abs(length[length > 0] - 1) < 1e-5).all() and (length > 0).mean() > 0.9
    center = camera_center(first.rotation, first.translation)
    towards = ((center - cloud.points) * cloud.normals).sum(axis=1)
    assert (towards[length > 0] > 0).mean() > 0.99


def test_exact_maps_give_colored_points_on_the_surfaces(solved) -> None:
    points, colors, *_ = fuse_depth_maps(solved.best, solved.views.__getitem__)
    assert_covers_every_map(solved, points)
    scene = room_scene()
    image = solved.best.images[0]
    pose = np.column_stack([image.rotation, image.translation])
    xy, depth = project(image.camera, pose, points)
    inside = (depth > 0) & (xy > 1).all(1) & (xy < np.array(image.camera.size) - 1).all(1)
    surface = scene.sample(image.camera, pose, xy[inside]).depth
    # No point is in front of the surface; points behind the surface are from other images.
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
    alone = replace(uncertain, images=(uncertain.images[1],))
    cloud = fuse_depth_maps(alone, solved.views.__getitem__)
    assert len(cloud.points) == old.valid[30:].sum()


def test_depth_of_large_std_gives_a_cloud(solved) -> None:
    images = tuple(
        replace(image, depth=replace(old, variance=(0.25 * old.depth) ** 2))
        for image in solved.best.images
        if (old := image.depth)
    )
    vague = replace(solved.best, images=images)
    points, *_ = fuse_depth_maps(vague, solved.views.__getitem__)
    assert_covers_every_map(solved, points)


@pytest.mark.parametrize(("sure", "left"), [(0.4, 0.4), (0.1, 0.25)])
def test_quarter_of_pixels_with_smallest_std_is_kept(solved, sure: float, left: float) -> None:
    old = solved.best.images[1].depth
    spread = np.linspace(0.2, 0.4, old.depth.size).reshape(old.depth.shape)
    spread.ravel()[: int(sure * old.depth.size)] = 0.01
    unsure = with_depth(solved, 1, old.depth, (spread * old.depth).astype(np.float32) ** 2)
    alone = replace(unsure, images=(unsure.images[1],))
    cloud = fuse_depth_maps(alone, solved.views.__getitem__)
    assert old.valid.all()
    assert len(cloud.points) == pytest.approx(left * old.valid.sum(), abs=2)


def test_surface_in_free_space_is_left_out(solved) -> None:
    depth = solved.best.images[1].depth.depth.copy()
    depth[20:40, 30:50] = 1.0  # a wall that other images contradict
    walled = with_depth(solved, 1, depth)
    points, *_ = fuse_depth_maps(walled, solved.views.__getitem__)
    image = solved.best.images[1]
    z = (points @ image.rotation.T + image.translation)[:, 2]
    assert ((z > 0.99) & (z < 1.01)).sum() < 0.1 * 400


def test_tentative_images_are_left_out(solved) -> None:
    first, second, third = solved.best.images
    guessed = replace(third, confirmed=False, translation=third.translation + 5.0)
    doubtful = replace(solved.best, images=(first, second, guessed))
    without = replace(solved.best, images=(first, second))
    points, *_ = fuse_depth_maps(doubtful, solved.views.__getitem__)
    expected, *_ = fuse_depth_maps(without, solved.views.__getitem__)
    np.testing.assert_array_equal(points, expected)


@pytest.mark.parametrize("limit", [1, 500])
def test_size_limit_selects_points_repeatably(solved, limit: int) -> None:
    points, colors, *_ = fuse_depth_maps(solved.best, solved.views.__getitem__, limit, seed=3)
    assert len(points) == len(colors) <= limit
    assert len(points) > 0.8 * limit - 1
    again, *_ = fuse_depth_maps(solved.best, solved.views.__getitem__, limit, seed=3)
    np.testing.assert_array_equal(points, again)
