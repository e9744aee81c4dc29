"""Tests of the radial distortion of rays against pycolmap's SIMPLE_RADIAL."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.geometry.distortion import (
    MIN_SLOPE,
    change_distortion,
    distort_rays,
    undistort_rays,
)


@pytest.mark.parametrize("radial", [-0.25, -0.03, 0.0, 0.1])
def test_distort_rays_equals_pycolmap_and_undistort_rays_inverts(radial: float) -> None:
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=100, height=100, params=[1.0, 0.0, 0.0, radial]
    )
    distorted = distort_rays(rays, radial)
    expected = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(distorted, expected, atol=1e-12)
    np.testing.assert_allclose(undistort_rays(distorted, radial), rays, atol=1e-12)


def test_undistort_rays_without_an_inverse_returns_the_largest_radius() -> None:
    undistorted = undistort_rays(np.array([[3.0, 0.0], [0.0, 0.0]]), -0.3)
    radius = np.hypot(*undistorted[0])
    assert 1 + 3 * -0.3 * radius**2 == pytest.approx(MIN_SLOPE)
    assert undistorted[1].tolist() == [0, 0]


def test_change_distortion_of_undistorted_pixels_equals_undistortion_of_the_original() -> None:
    original = np.random.default_rng(0).uniform([0, 0], [640, 480], (50, 2))
    old, new = (
        PinholeCamera(640, 480, 500, 500, 320, 240),
        PinholeCamera(640, 480, 550, 550, 320, 240),
    )
    start = change_distortion(original, (old, 0.0), (old, -0.1))
    changed = change_distortion(start, (old, -0.1), (new, -0.15))
    expected = change_distortion(original, (new, 0.0), (new, -0.15))
    np.testing.assert_allclose(changed, expected, atol=1e-9)
