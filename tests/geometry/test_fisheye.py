"""Fisheye: Tests of the projection beyond 180 degrees and of views that cover a fisheye image."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.geometry.fisheye import (
    find_visible_angles_deg,
    make_fisheye_view_rotations,
    measure_field_of_view_deg,
    project_wide,
)

CAMERAS = {
    "SIMPLE_FISHEYE": [300, 500, 490],
    "FISHEYE": [300, 310, 500, 490],
    "SIMPLE_RADIAL_FISHEYE": [300, 500, 500, -0.02],
    "RADIAL_FISHEYE": [300, 500, 500, -0.02, 0.003],
    "OPENCV_FISHEYE": [300, 310, 500, 490, -0.02, 0.003, 0.001, -0.0002],
    "THIN_PRISM_FISHEYE": [300, 300, 500, 500, -0.02, 0.003, 1e-3, 2e-3, 3e-4, -1e-4, 2e-3, 1e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(300, 310, 500, 490, 0.01, 0.002, -0.001, 3e-4, -1e-4, 1e-5),
        *(0.001, 0.002, 0.001, 5e-4, -4e-4, 3e-4),
    ],
    "EUCM": [300, 300, 500, 500, 0.6, 1.1],
}


def make_camera(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=1000, height=1000, params=CAMERAS[model])


@pytest.mark.parametrize("model", CAMERAS)
def test_project_wide_equals_colmap_in_front_of_the_camera(model: str) -> None:
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    camera = make_camera(model)
    np.testing.assert_allclose(
        project_wide(camera, directions), camera.img_from_cam(directions), rtol=1e-9
    )


def test_project_wide_beyond_180_degrees_is_the_distortion_polynomial() -> None:
    fx, fy, cx, cy, *coefficients = CAMERAS["OPENCV_FISHEYE"]
    angle, azimuth = np.radians(108), 0.7
    direction = [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
    distorted = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(coefficients, 1)))
    pixel = project_wide(make_camera("OPENCV_FISHEYE"), np.array([direction]))[0]
    expected = [cx + fx * distorted * np.cos(azimuth), cy + fy * distorted * np.sin(azimuth)]
    np.testing.assert_allclose(pixel, expected)


def test_visible_angle_ends_where_the_distortion_turns_back() -> None:
    # At the viewing angle t, the distance from the principal point is 300 (t - 0.1 t^3) pixels. It
    # is largest where its derivative 300 (1 - 0.3 t^2) is 0: at t = 1.826 radians, 104.6 degrees.
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL_FISHEYE", width=4000, height=4000, params=[300, 2000, 2000, -0.1]
    )
    assert find_visible_angles_deg(camera) == pytest.approx(104.6, abs=0.3)


def test_field_of_view_is_that_across_the_wider_side() -> None:
    camera = pycolmap.Camera(model="SIMPLE_FISHEYE", width=628, height=400, params=[300, 314, 200])
    assert measure_field_of_view_deg(camera) == pytest.approx(120, abs=0.5)


@pytest.mark.parametrize("half_angle_deg", [62, 75, 80, 95, 110])
def test_views_cover_98_percent_of_a_fisheye_image_and_are_level(half_angle_deg: float) -> None:
    rotations = make_fisheye_view_rotations(half_angle_deg)
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[directions[:, 2] > np.cos(np.radians(half_angle_deg))]
    x, y, z = np.moveaxis(directions @ rotations.transpose(0, 2, 1), -1, 0)
    assert ((np.maximum(np.abs(x), np.abs(y)) < z).any(axis=0)).mean() > 0.98
    np.testing.assert_allclose(rotations[:, 0, 1], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
