"""Panorama views: Tests of cutting equirectangular panoramas into perspective views of a rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import Float64, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.panorama import (
    make_view_camera,
    make_view_rotations,
    panorama_pixels,
    view_pixels_in_panorama,
)
from mpsfm_core.inputs.panorama_views import cut_panorama, cut_panoramas
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, room_scene

PANORAMA_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
EYE = np.array([0.3, -0.4, 1.4])


def render_panorama(scene: AnalyticScene, eye: Float64, height: int) -> UInt8:
    """Render an equirectangular panorama, whose middle looks along y of the world."""
    xy = np.stack(np.meshgrid(np.arange(2 * height), np.arange(height)), axis=-1) + 0.5
    longitude, latitude = ((xy / height - [1, 0.5]) * np.pi).reshape(-1, 2).T
    directions = np.stack(
        [
            np.sin(longitude) * np.cos(latitude),
            np.sin(latitude),
            np.cos(longitude) * np.cos(latitude),
        ],
        axis=1,
    )
    np.testing.assert_allclose(
        panorama_pixels(directions, (2 * height, height)), xy.reshape(-1, 2), atol=1e-9
    )
    distance, _, surface = scene.first_hit(eye, directions @ PANORAMA_FROM_WORLD)
    points = eye + distance[:, None] * (directions @ PANORAMA_FROM_WORLD)
    rgb = scene.texture.colors(points, surface, distance * np.pi / height)
    return rgb.reshape(height, 2 * height, 3)


def test_views_equal_rendered_perspective_images() -> None:
    scene = room_scene()
    views = cut_panorama(render_panorama(scene, EYE, 256))
    camera = make_view_camera(512)
    for rotation, view in zip(make_view_rotations(), views, strict=True):
        turn = rotation @ PANORAMA_FROM_WORLD
        truth = scene.render(camera, np.column_stack([turn, -turn @ EYE])).rgb
        assert view.shape == truth.shape
        assert np.median(np.abs(view.astype(int) - truth)) <= 8


def test_views_cover_the_seam_of_the_panorama() -> None:
    camera, size = make_view_camera(512), (512, 256)
    columns = [
        view_pixels_in_panorama(camera, rotation, size)[camera.height // 2, :, 0]
        for rotation in make_view_rotations()
    ]
    seen = np.unique(np.concatenate(columns).astype(int) % 512)
    assert len(seen) == 512


def test_cut_panoramas_writes_views_cameras_and_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, (64, 128, 3)).astype(np.uint8))
    views = cut_panoramas(tmp_path, ["a.png", "b.png"], tmp_path / "views", 10**6)
    assert views.rig.frames[1][3] == "camera3/b.jpg"
    assert not views.rig.has_baseline
    assert set(views.cameras) == set(views.rig.image_names)
    for name, camera in views.cameras.items():
        image = cv2.imread(str(views.folder / name))
        assert image.shape[:2] == (camera.height, camera.width)


def test_views_of_earlier_panoramas_are_removed(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((32, 64, 3), np.uint8))
    for name in ("a.png", "b.png"):
        views = cut_panoramas(tmp_path, [name], tmp_path / "views", 10**6)
    written = {path.relative_to(views.folder).as_posix() for path in views.folder.rglob("*.jpg")}
    assert written == {f"camera{view}/b.jpg" for view in range(8)}


def test_image_that_is_not_twice_as_wide_as_high_is_an_error(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((64, 96, 3), np.uint8))
    with pytest.raises(InputError, match=r"a\.png has 96 x 64 pixels.*twice as wide"):
        cut_panoramas(tmp_path, ["a.png"], tmp_path / "views", 10**6)
