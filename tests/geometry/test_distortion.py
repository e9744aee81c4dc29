"""Distortion of rays, compared with pycolmap's camera models."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.data.camera_models import CameraModel, Distortion
from mpsfm_core.geometry.distortion import (
    MAX_FISHEYE_ANGLE,
    MIN_SLOPE,
    change_distortion,
    distort_rays,
    undistort_rays,
)

RADIAL, RADIAL2 = CameraModel.SIMPLE_RADIAL, CameraModel.RADIAL
OPENCV, FISHEYE = CameraModel.OPENCV, CameraModel.OPENCV_FISHEYE


def simple_radial(coefficient: float) -> Distortion:
    """Return the distortion coefficients of a SIMPLE_RADIAL camera."""
    return coefficient, 0.0, 0.0, 0.0


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        (RADIAL, simple_radial(-0.25)),
        (RADIAL, simple_radial(0.0)),
        (RADIAL, simple_radial(0.1)),
        (RADIAL2, (-0.2, 0.05, 0.0, 0.0)),
        (RADIAL2, (0.1, -0.05, 0.0, 0.0)),
        (OPENCV, (-0.2, 0.05, 0.01, -0.006)),
        (FISHEYE, (0.0, 0.0, 0.0, 0.0)),
        (FISHEYE, (0.03, -0.02, 0.01, -0.003)),
    ],
)
def test_distort_rays_equals_pycolmap_and_undistort_rays_inverts(
    model: CameraModel, coefficients: Distortion
) -> None:
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    rays[:2] = [0.0, 0.0], [1e-9, 0.0]
    params = model.to_params(np.array([1.0, 1.0, 0.0, 0.0]), np.array(coefficients))
    camera = pycolmap.Camera(model=model.value, width=100, height=100, params=params)
    distorted = distort_rays(rays, coefficients, fisheye=model.is_fisheye)
    expected = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(distorted, expected, atol=1e-12)
    inverse = undistort_rays(distorted, coefficients, fisheye=model.is_fisheye)
    np.testing.assert_allclose(inverse, rays, atol=1e-12)


def test_undistort_rays_without_an_inverse_returns_the_largest_radius() -> None:
    undistorted = undistort_rays(np.array([[3.0, 0.0], [0.0, 0.0]]), simple_radial(-0.3))
    radius = np.hypot(*undistorted[0])
    assert 1 + 3 * -0.3 * radius**2 == pytest.approx(MIN_SLOPE)
    assert undistorted[1].tolist() == [0, 0]


def test_undistort_rays_of_a_fisheye_beyond_the_largest_angle_returns_the_largest_angle() -> None:
    undistorted = undistort_rays(np.array([[2.0, 0.0]]), (0.0, 0.0, 0.0, 0.0), fisheye=True)
    np.testing.assert_allclose(undistorted, [[np.tan(MAX_FISHEYE_ANGLE), 0.0]])


def test_change_distortion_of_undistorted_pixels_equals_undistortion_of_the_original() -> None:
    original = np.random.default_rng(0).uniform([0, 0], [640, 480], (50, 2))
    old, new = (
        PinholeCamera(640, 480, 500, 500, 320, 240),
        PinholeCamera(640, 480, 550, 550, 320, 240),
    )
    none = simple_radial(0.0)
    first, second = simple_radial(-0.1), (-0.15, 0.02, 0.003, -0.002)
    start: Float64 = change_distortion(original, (old, none), (old, first))
    changed = change_distortion(start, (old, first), (new, second))
    expected = change_distortion(original, (new, none), (new, second))
    np.testing.assert_allclose(changed, expected, atol=1e-9)
