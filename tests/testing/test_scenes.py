"""Tests that analytic scenes are exact: geometry, normals, correspondences and colors agree."""

import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.testing.synthetic.scenes import (
    AnalyticScene,
    Box,
    Plane,
    Sphere,
    arc_poses,
    look_at,
    project,
    room_scene,
)

CAMERA = PinholeCamera(97, 64, 75.0, 74.0, 48.0, 32.5)


def pixel_grid(camera: PinholeCamera) -> np.ndarray:
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize(
    ("surface", "depth", "normal"),
    [
        (Plane((0, 4, 0), (0, 1, 0)), 4.0, (0, 0, -1)),
        (Box((0, 4, 0), (1, 1, 1)), 3.0, (0, 0, -1)),
        (Box((0, 0, 0), (5, 5, 5)), 5.0, (0, 0, -1)),
        (Sphere((0, 4, 0), 1.5), 2.5, (0, 0, -1)),
        (Sphere((0, 1, 0), 3.0), 4.0, (0, 0, -1)),
    ],
)
def test_known_hits_straight_ahead(surface, depth, normal):
    scene = AnalyticScene((surface,))
    seen = scene.sample(CAMERA, look_at((0, 0, 0), (0, 1, 0)), [[CAMERA.cx, CAMERA.cy]])
    np.testing.assert_allclose(seen.depth, [depth])
    np.testing.assert_allclose(seen.normals, [normal], atol=1e-12)
    np.testing.assert_allclose(seen.points, [[0, depth, 0]], atol=1e-12)


def test_nothing_in_sight_is_zero():
    scene = AnalyticScene((Plane((0, -4, 0), (0, 1, 0)),))
    rendering = scene.render(CAMERA, look_at((0, 0, 0), (0, 1, 0)))
    assert not rendering.depth.any()
    assert not rendering.normals.any()
    assert not rendering.rgb.any()


def test_normals_are_unit_face_the_ray_and_fit_the_surface():
    scene, pose = room_scene(), arc_poses(1, 0)[0]
    xy = pixel_grid(CAMERA)
    seen = scene.sample(CAMERA, pose, xy)
    right = scene.sample(CAMERA, pose, xy + np.array([1e-4, 0]))
    same = (seen.surface == right.surface) & (np.abs(seen.normals - right.normals).max(1) < 1e-3)
    world_normals = seen.normals @ np.asarray(pose)[:, :3]
    rays = seen.points - scene_origin(pose)
    assert seen.valid.all()
    np.testing.assert_allclose(np.linalg.norm(seen.normals, axis=1), 1, rtol=1e-12)
    assert (np.einsum("ni,ni->n", world_normals, rays) < 0).all()
    along = np.einsum("ni,ni->n", world_normals, right.points - seen.points)
    assert same.mean() > 0.95
    assert np.abs(along[same]).max() < 1e-7


def scene_origin(pose):
    return -pose[:, :3].T @ pose[:, 3]


def test_points_project_back_to_their_pixels_and_depths():
    xy = pixel_grid(CAMERA)
    for pose in arc_poses(3, 20):
        seen = room_scene().sample(CAMERA, pose, xy)
        projected, depth = project(CAMERA, pose, seen.points)
        np.testing.assert_allclose(projected, xy, atol=1e-9)
        np.testing.assert_allclose(depth, seen.depth, rtol=1e-12)


def test_correspondences_are_mutual_and_see_the_same_colour():
    scene, (pose_a, pose_b) = room_scene(), arc_poses(2, 8)
    xy = pixel_grid(CAMERA)
    there = scene.correspondences(CAMERA, pose_a, CAMERA, pose_b, xy)
    xy_b = there.xy_b[there.visible]
    back = scene.correspondences(CAMERA, pose_b, CAMERA, pose_a, xy_b)
    assert 0.5 < there.visible.mean() < 1.0
    assert back.visible.mean() > 0.99  # Image borders are inclusive on one side only.
    np.testing.assert_allclose(back.xy_b[back.visible], xy[there.visible][back.visible], atol=1e-6)
    size = np.full(len(xy), 0.03)
    a = scene.sample(CAMERA, pose_a, xy)
    b = scene.sample(CAMERA, pose_b, xy_b)
    colors = scene.texture.colors(a.points, a.surface, size)[there.visible].astype(int)
    colors_b = scene.texture.colors(b.points, b.surface, size[: len(xy_b)]).astype(int)
    assert np.abs(colors - colors_b).max() <= 2


def test_occluded_points_have_no_correspondence():
    wall, ball = Plane((0, 6, 0), (0, 1, 0)), Sphere((0, 3, 0), 0.5)
    pose_a, pose_b = look_at((-2, 0, 0), (0, 6, 0)), look_at((0, 0, 0), (0, 6, 0))
    scene = AnalyticScene((wall, ball))
    hit = scene.correspondences(CAMERA, pose_a, CAMERA, pose_b, [[CAMERA.cx, CAMERA.cy]])
    assert not hit.visible[0]
    free = AnalyticScene((wall,))
    hit = free.correspondences(CAMERA, pose_a, CAMERA, pose_b, [[CAMERA.cx, CAMERA.cy]])
    assert hit.visible[0]
    np.testing.assert_allclose(hit.xy_b, [[CAMERA.cx, CAMERA.cy]], atol=1e-9)


def test_rendering_is_deterministic_textured_and_of_boundary_types():
    pose = arc_poses(1, 0)[0]
    first, second = (room_scene(seed=3).render(CAMERA, pose) for _ in range(2))
    assert (first.rgb == second.rgb).all()
    assert (room_scene(seed=4).render(CAMERA, pose).rgb != first.rgb).mean() > 0.5
    assert (first.depth.dtype, first.normals.dtype, first.rgb.dtype) == (
        np.float32,
        np.float32,
        np.uint8,
    )
    assert first.depth.shape == (CAMERA.height, CAMERA.width)
    assert first.rgb.std() > 30
