"""View cutting: Tests of cutting panoramas and fisheye images into perspective views of rigs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import Float64, Rig, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.fisheye import project_wide
from mpsfm_core.geometry.panorama import make_panorama_camera
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.masks import decode_mask
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.view_cutting import (
    CutImages,
    ViewCutter,
    cut_images,
    find_wide_cameras,
)
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
    camera = make_panorama_camera(2 * height, height)
    np.testing.assert_allclose(camera.img_from_cam(directions), xy.reshape(-1, 2), atol=1e-9)
    distance, _, surface = scene.first_hit(eye, directions @ PANORAMA_FROM_WORLD)
    points = eye + distance[:, None] * (directions @ PANORAMA_FROM_WORLD)
    rgb = scene.texture.colors(points, surface, distance * np.pi / height)
    return rgb.reshape(height, 2 * height, 3)


def test_views_equal_rendered_perspective_images() -> None:
    scene = room_scene()
    cutter = ViewCutter(make_panorama_camera(512, 256))
    views = cutter.cut(render_panorama(scene, EYE, 256))
    for rotation, view in zip(cutter.rotations, views, strict=True):
        turn = rotation @ PANORAMA_FROM_WORLD
        truth = scene.render(cutter.camera, np.column_stack([turn, -turn @ EYE])).rgb
        assert view.shape == truth.shape
        assert np.median(np.abs(view.astype(int) - truth)) <= 8


FISHEYE = pycolmap.Camera(
    model="OPENCV_FISHEYE",
    width=440,
    height=400,
    params=[115, 115, 220, 200, -0.02, 0.003, 0, 0],
)
"""Fisheye camera with a horizontal field of view of about 220 degrees."""


def render_fisheye(scene: AnalyticScene, cam_from_world: Float64, eye: Float64) -> UInt8:
    """Render a fisheye image by nearest neighbors of a dense set of directions."""
    xy = np.stack(np.meshgrid(np.arange(1440), np.arange(720)), axis=-1) + 0.5
    longitude, latitude = ((xy / 720 - [1, 0.5]) * np.pi).reshape(-1, 2).T
    directions = np.stack(
        [
            np.sin(longitude) * np.cos(latitude),
            np.sin(latitude),
            np.cos(longitude) * np.cos(latitude),
        ],
        axis=1,
    )
    pixels = np.floor(project_wide(FISHEYE, directions))
    inside = (pixels >= 0).all(axis=1) & (pixels < [FISHEYE.width, FISHEYE.height]).all(axis=1)
    inside &= directions[:, 2] > np.cos(np.radians(125))
    columns, rows = pixels[inside].astype(int).T
    distance, _, surface = scene.first_hit(eye, directions[inside] @ cam_from_world)
    points = eye + distance[:, None] * (directions[inside] @ cam_from_world)
    image = np.zeros((FISHEYE.height, FISHEYE.width, 3), np.uint8)
    image[rows, columns] = scene.texture.colors(points, surface, distance * 0.01)
    return image


def test_views_of_a_fisheye_image_beyond_180_degrees_equal_rendered_images() -> None:
    scene = room_scene()
    cutter = ViewCutter(FISHEYE)
    image = render_fisheye(scene, PANORAMA_FROM_WORLD, EYE)
    views = cutter.cut(image)
    masks = cutter.cut_mask(image.any(axis=2))
    assert len(views) == len(cutter.rotations) == 7
    for rotation, view, mask in zip(cutter.rotations, views, masks, strict=True):
        turn = rotation @ PANORAMA_FROM_WORLD
        truth = scene.render(cutter.camera, np.column_stack([turn, -turn @ EYE])).rgb
        assert mask.mean() > 0.4
        assert np.median(np.abs(view.astype(int) - truth)[mask]) <= 12


def test_views_cover_the_whole_panorama_around_the_horizon() -> None:
    cutter = ViewCutter(make_panorama_camera(512, 256))
    angles = np.linspace(0, 2 * np.pi, 200)
    directions = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    x, _, z = np.moveaxis(directions @ cutter.rotations.transpose(0, 2, 1), -1, 0)
    assert ((z > 0) & (np.abs(x) <= z)).sum(axis=0).min() >= 2


def write_images(folder: Path, names: list[str], size: tuple[int, int] = (128, 64)) -> None:
    rng = np.random.default_rng(0)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = rng.integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
        cv2.imwrite(str(folder / name), pixels)


def cut(folder: Path, names: list[str], **options: object) -> CutImages:
    return cut_images(
        folder,
        names,
        folder / "views",
        folder / "view_masks",
        InputOptions.model_validate(options),
    )


def test_cut_images_writes_views_cameras_and_frames(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png", "b.png"])
    views = cut(tmp_path, ["a.png", "b.png"])
    (rig,) = views.rigs
    assert rig.frames[1][3] == "camera3/b.jpg"
    assert not rig.has_baseline
    assert views.masks is None
    assert set(views.cameras) == set(rig.image_names)
    for name, camera in views.cameras.items():
        image = cv2.imread(str(views.folder / name))
        assert image is not None
        assert image.shape[:2] == (camera.height, camera.width)


def test_views_of_earlier_panoramas_are_removed(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png", "b.png"])
    for name in ("a.png", "b.png"):
        views = cut(tmp_path, [name])
    written = {path.relative_to(views.folder).as_posix() for path in views.folder.rglob("*.jpg")}
    assert written == {f"camera{view}/b.jpg" for view in range(8)}


def test_image_that_is_not_twice_as_wide_as_high_is_an_error(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png"], (96, 64))
    with pytest.raises(InputError, match=r"a\.png has 96 x 64 pixels.*twice as wide"):
        cut(tmp_path, ["a.png"])


def test_nadir_angle_masks_the_lower_pixels_of_all_views(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png"])
    views = cut(tmp_path, ["a.png"], nadir_angle_deg=60)
    assert views.masks is not None
    for name in views.cameras:
        mask = decode_mask(views.masks / f"{name}.png", 10**6)
        side = len(mask)
        # The middle column shows pixels 30 degrees below the horizon at tan(30 deg) of its half.
        first = side / 2 * (1 + np.tan(np.radians(30)))
        assert abs(mask[:, side // 2].sum() - first) <= 1


def test_masked_pixels_are_masked_in_the_loaded_views(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png", "b.png"])
    views = cut(tmp_path, ["a.png", "b.png"], nadir_angle_deg=60)
    options = InputOptions(masks=views.masks)
    images = load_images(views.folder, views.cameras, options=options)
    assert len(images) == 16
    for index in range(16):
        mask = images.view(index).mask
        assert mask is not None
        assert mask[: len(mask) // 2].all() and not mask[-1, len(mask) // 2]


def test_one_mask_file_masks_all_panoramas(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png", "b.png"])
    mask = np.full((64, 128), 255, np.uint8)
    mask[:, 48:80] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    views = cut(tmp_path, ["a.png", "b.png"], masks=tmp_path / "mask.png")
    assert views.masks is not None
    for name in ("a.jpg", "b.jpg"):
        assert not decode_mask(views.masks / f"camera0/{name}.png", 10**6).any()
        assert decode_mask(views.masks / f"camera4/{name}.png", 10**6).all()


def test_fisheye_images_are_cut_and_other_images_are_copied(tmp_path: Path) -> None:
    write_images(tmp_path, ["wide.png"], (FISHEYE.width, FISHEYE.height))
    write_images(tmp_path, ["narrow.png"], (100, 80))
    narrow = pycolmap.Camera(
        model="OPENCV", width=100, height=80, params=[90, 90, 50, 40, 0.1, 0, 0, 0]
    )
    names, given = ["narrow.png", "wide.png"], {"wide.png": FISHEYE, "narrow.png": narrow}
    cameras = find_wide_cameras(tmp_path, names, given, InputOptions())
    views = cut_images(
        tmp_path, names, tmp_path / "v", tmp_path / "m", InputOptions(), cameras=cameras
    )
    copied = views.cameras["narrow.png"]
    assert isinstance(copied, pycolmap.Camera)
    assert list(copied.params) == list(narrow.params)
    assert (views.folder / "narrow.png").read_bytes() == (tmp_path / "narrow.png").read_bytes()
    (rig,) = views.rigs
    assert rig.frames == (tuple(f"camera{k}/wide.jpg" for k in range(7)),)
    assert views.masks is not None
    assert not decode_mask(views.masks / "camera1/wide.jpg.png", 10**6).all()


def test_narrow_fisheye_images_are_not_cut(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png"], (200, 150))
    camera = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=200, height=150, params=[120, 120, 100, 75, 0, 0, 0, 0]
    )
    assert find_wide_cameras(tmp_path, ["a.png"], {"a.png": camera}, InputOptions()) == {}


def test_rig_of_two_fisheye_cameras_becomes_a_rig_of_views(tmp_path: Path) -> None:
    names = ["front/1.png", "back/1.png"]
    write_images(tmp_path, names, (FISHEYE.width, FISHEYE.height))
    turn = np.diag([-1.0, 1.0, -1.0])
    poses = (np.eye(3), np.zeros(3)), (turn, np.array([0.0, 0.0, -0.02]))
    rig = Rig(poses, (("front/1.png", "back/1.png"),))
    views = cut_images(
        *(tmp_path, names, tmp_path / "v", tmp_path / "m", InputOptions()),
        cameras=dict.fromkeys(names, FISHEYE),
        rigs=[rig],
    )
    (view_rig,) = views.rigs
    assert view_rig.has_baseline
    assert view_rig.frames == (
        tuple(f"camera{k}/{side}/1.jpg" for side in ("front", "back") for k in range(7)),
    )
    rotations = ViewCutter(FISHEYE).rotations
    back, shift = view_rig.sensor_poses[7 + 2]
    np.testing.assert_allclose(back, rotations[2] @ turn)
    np.testing.assert_allclose(shift, rotations[2] @ [0, 0, -0.02])
    unknown = Rig((poses[0], None), rig.frames)
    with pytest.raises(InputError, match="field of view above 120 degrees"):
        cut_images(
            *(tmp_path, names, tmp_path / "v", tmp_path / "m", InputOptions()),
            cameras=dict.fromkeys(names, FISHEYE),
            rigs=[unknown],
        )
