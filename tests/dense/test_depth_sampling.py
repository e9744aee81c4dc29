"""Tests of the interpolation and the slant of depth maps."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import Float32, Float64
from mpsfm_core.dense.depth_sampling import compute_slant, sample_depth

INTRINSICS = np.array([50.0, 60.0, 40.0, 30.0])
SIZE = 80, 60


def plane_depth(normal: Float64, xy: Float64) -> Float64:
    """Return the depth at pixels (..., 2) of a plane at distance 2 with a unit normal."""
    fx, fy, cx, cy = INTRINSICS
    ray = np.stack([(xy[..., 0] - cx) / fx, (xy[..., 1] - cy) / fy, np.ones(xy.shape[:-1])], -1)
    depth: Float64 = 2 / (ray @ normal)
    return depth


def pixels() -> Float64:
    return np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1)


def plane_map(normal: Float64) -> Float32:
    return plane_depth(normal, pixels()).astype(np.float32)


@pytest.mark.parametrize("tilt", [(0, 0, 1), (0, 0.7, 1), (-0.5, 0.4, 1)])
def test_depth_and_slant_of_plane_are_exact(tilt: tuple[float, float, float]) -> None:
    normal = np.array(tilt) / np.linalg.norm(tilt)
    depth = plane_map(normal)
    xy = np.random.default_rng(0).uniform((1, 1), np.array(SIZE) - 1, (500, 2))
    np.testing.assert_allclose(sample_depth(depth, xy), plane_depth(normal, xy), rtol=1e-5)
    slant = compute_slant(depth, INTRINSICS)[5:-5, 5:-5]
    # The distance along the normal is the distance along z times the normal times the ray.
    expected = 2 / plane_depth(normal, pixels())[5:-5, 5:-5]
    np.testing.assert_allclose(slant, expected, rtol=1e-3)


def test_depth_edge_is_not_interpolated_and_has_no_slant() -> None:
    depth = plane_map(np.array([0.0, 0.6, 0.8]))
    depth[:, 40:] *= 2
    xy = np.array([[39.9, 30.0], [40.1, 30.0]])
    near, far = sample_depth(depth, xy)
    assert far == pytest.approx(2 * near, rel=0.05)
    slant = compute_slant(depth, INTRINSICS)
    assert (slant[5:-5, 38:42] == 1).all() and (slant[5:-5, 5:30] < 1).any()
