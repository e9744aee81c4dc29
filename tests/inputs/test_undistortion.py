"""Tests of undistorted views against COLMAP's undistortion."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.geometry import pixel_centers, project
from mpsfm_core.geometry.pycolmap_conversion import pinhole_from_colmap
from mpsfm_core.inputs.undistortion import (
    UndistortionMap,
    distort_pixels,
    is_pinhole,
    resize_camera,
    undistort_camera,
)

WIDTH, HEIGHT = 160, 120
MODELS = {
    "SIMPLE_RADIAL": [130, 82, 59, 0.08],
    "OPENCV": [130, 132, 79, 61, -0.15, 0.03, 0.002, -0.001],
    "FULL_OPENCV": [130, 131, 80, 60, 0.05, -0.01, 0.001, 0.001, 0.002, 0.01, 0.0, 0.0],
    "OPENCV_FISHEYE": [95, 96, 81, 59, 0.02, 0.003, 0, 0],
    "SIMPLE_FISHEYE": [90, 80, 60],
    "FOV": [100, 100, 80, 60, 0.7],
    "THIN_PRISM_FISHEYE": [95, 96, 81, 59, 0.02, 0.003, 1e-3, 1e-3, 0, 0, 1e-3, 1e-3],
    "SIMPLE_DIVISION": [130, 80, 60, -0.05],
}


def camera(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=MODELS[model])


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    waves = [np.sin(columns / 7 + k) * np.cos(rows / 9 - k) for k in range(3)]
    return np.round(127 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)


@pytest.mark.parametrize("model", MODELS)
def test_same_as_colmap(model: str, image: np.ndarray) -> None:
    original = camera(model)
    pinhole = undistort_camera(original)
    options = pycolmap.UndistortCameraOptions()
    bitmap, colmap = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(image), original)
    assert pinhole.size == (colmap.width, colmap.height)
    assert np.allclose(pinhole.params, colmap.params)
    inner = np.s_[2:-2, 2:-2]  # COLMAP leaves a black rim of half a pixel
    warped = UndistortionMap(original, pinhole).image(image)
    difference = np.abs(warped.astype(int) - bitmap.to_array())[inner]
    assert difference.max() <= 1


@pytest.mark.parametrize("model", MODELS)
def test_to_original_follows_the_camera_model(model: str) -> None:
    original = camera(model)
    pinhole = undistort_camera(original)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.ones(50)])
    seen = distort_pixels(pinhole, original, project(pinhole, points))
    assert np.allclose(seen, original.img_from_cam(points), atol=1e-9)


def test_pinhole_needs_no_warp() -> None:
    plain = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 505, 310, 245])
    assert is_pinhole(plain)
    assert undistort_camera(plain).params.tolist() == [500, 505, 310, 245]
    straight = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0.0]
    )
    assert is_pinhole(straight) and undistort_camera(straight).size == (640, 480)
    # A fisheye camera with zero distortion coefficients is no pinhole camera.
    assert not is_pinhole(camera("SIMPLE_FISHEYE"))


def test_reduced_pinhole_maps_back() -> None:
    plain = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 505, 310, 245])
    reduced = undistort_camera(resize_camera(plain, (320, 240)))
    assert reduced.params.tolist() == [250, 252.5, 155, 122.5]
    xy = np.array([[0.5, 0.5], [320.0, 240.0]])
    assert distort_pixels(reduced, plain, xy).tolist() == [[1.0, 1.0], [640.0, 480.0]]
    assert (plain.width, plain.height) == (640, 480)


def test_reduced_distorted_maps_back() -> None:
    original = camera("OPENCV")
    reduced = resize_camera(original, (80, 60))
    pinhole = undistort_camera(reduced)
    xy = pixel_centers(*pinhole.size).reshape(-1, 2)
    scaled = distort_pixels(pinhole, reduced, xy) * 2
    assert np.allclose(distort_pixels(pinhole, original, xy), scaled, atol=1e-9)


def test_blank_pixels_are_masked(image: np.ndarray) -> None:
    original = camera("OPENCV")
    original.params = [130, 132, 79, 61, 0.25, 0.05, 0.0, 0.0]
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 1.0
    full = UndistortionMap(
        original, pinhole_from_colmap(pycolmap.undistort_camera(options, original))
    )
    assert 0.005 < 1 - full.valid.mean() < 0.5
    bright = np.full_like(image, 200)
    warped = full.image(bright)
    assert (warped[full.valid] == 200).all() and (warped[~full.valid] == 0).all()
    cropped = UndistortionMap(original, undistort_camera(original))
    assert cropped.valid.all()


def test_mask_is_warped_with_the_image(image: np.ndarray) -> None:
    original = camera("OPENCV")
    warp = UndistortionMap(original, undistort_camera(original))
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    mask[:, WIDTH // 2 :] = True
    painted = np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255
    agreement = warp.mask(mask) == (warp.image(painted)[..., 0] > 127)
    assert agreement.mean() > 0.999
