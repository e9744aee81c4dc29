"""Tests of the conversion of network outputs against independent computations."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_onnx.decode import (
    compute_expected_angle,
    decode_depth,
    decode_normals,
    estimate_z_shift,
    to_planes,
)
from mpsfm_onnx.description import ConfidenceOutput, DepthOutput, NormalsOutput
from scipy.integrate import quad
from scipy.optimize import least_squares

from mpsfm_core import PinholeCamera
from mpsfm_core.geometry import pixel_centers, rays, unproject


def depth_rule(**fields):
    return DepthOutput(name="d", metric=True, **fields)


def camera_of(value):
    """Return a camera for a depth map (h, w)."""
    height, width = np.shape(value)[:2]
    return PinholeCamera(width, height, 0.8 * width, 0.9 * width, 0.45 * width, 0.6 * height)


def decode(value, rule, *more):
    """Decode depth from a map (h, w) or (h, w, c)."""
    value = np.asarray(value, dtype=np.float32)
    value = value[..., None] if value.ndim == 2 else value
    return decode_depth(value, rule, camera_of(value), *more)


@pytest.mark.parametrize("kappa", [0.0, 0.01, 0.5, 2.0, 17.0, 300.0])
def test_expected_angle_is_the_mean_of_the_density(kappa):
    def density(angle):
        normaliser = 2 * np.pi * (1 + np.exp(-kappa * np.pi)) / (kappa**2 + 1)
        return np.exp(-kappa * angle) / normaliser * 2 * np.pi * np.sin(angle)

    peak = [1 / max(kappa, 1)]
    total, _ = quad(density, 0, np.pi, points=peak)
    mean, _ = quad(lambda a: a * density(a), 0, np.pi, points=peak)
    assert total == pytest.approx(1, rel=1e-7)
    assert compute_expected_angle(np.array(kappa)) == pytest.approx(mean, rel=1e-7)


def test_cautious_side_of_the_squared_angle():
    """Check that the variance of normals is 3/4 of the squared mean angle for large kappa."""
    kappa = 60.0
    density = [lambda a, p=p: a**p * np.exp(-kappa * a) * np.sin(a) for p in (0, 2)]
    norm, second = (quad(f, 0, np.pi, points=[1 / kappa])[0] for f in density)
    per_direction = second / norm / 2
    assert per_direction / compute_expected_angle(np.array(kappa)) ** 2 == pytest.approx(
        0.75, rel=0.01
    )


def test_disparity_and_log_depth():
    value = np.array([[0.5, 2.0, -1.0, 0.0]], dtype=np.float32)
    disparity = decode(value, depth_rule(output="disparity", scale=2.0, shift=1.0))
    assert disparity.valid.tolist() == [[True, True, False, True]]
    np.testing.assert_allclose(disparity.depth[0, [0, 1, 3]], [1 / 2, 1 / 5, 1.0])
    log = decode(value, depth_rule(output="log-depth"))
    np.testing.assert_allclose(log.depth[0], np.exp(value[0]), rtol=1e-6)


def test_valid_range_is_that_of_the_network_not_of_the_camera():
    rule = depth_rule(canonical_focal=1000.0, valid_max=200.0, valid_min=0.5)
    prior = decode([[0.4, 100.0, 199.0, 201.0, np.nan]], rule, 0.5)
    assert prior.valid.tolist() == [[False, True, True, False, False]]
    np.testing.assert_allclose(prior.depth[0, 1:3], [50.0, 99.5])


@pytest.mark.parametrize(
    ("output", "tensor", "std"),
    [
        ("confidence", 0.9, 0.2),
        ("confidence", 1.5, 2e-4),
        ("std", 0.3, 0.3),
        ("variance", 0.09, 0.3),
    ],
)
def test_uncertainty_scales_with_the_canonical_correction(output, tensor, std):
    confidence = np.full((1, 1), tensor, dtype=np.float32)
    rule = ConfidenceOutput(name="c", output=output)
    for ratio in (1.0, 0.25, 3.0):
        prior = decode(np.full((1, 1), 2.0), depth_rule(), ratio, confidence, rule)
        assert np.sqrt(prior.variance[0, 0]) == pytest.approx(std * ratio, rel=1e-5)


def test_ray_length_becomes_z():
    z = np.random.default_rng(0).uniform(1, 5, (6, 8))
    points = unproject(camera_of(z), pixel_centers(8, 6), z)
    prior = decode(np.linalg.norm(points, axis=-1), depth_rule(output="ray-length"))
    np.testing.assert_allclose(prior.depth, z, rtol=1e-6)


@pytest.mark.parametrize("shift", [0.7, -0.4])
def test_shift_of_points_is_estimated_from_the_camera(shift):
    z = np.random.default_rng(0).uniform(1, 5, (6, 8))
    points = unproject(camera_of(z), pixel_centers(8, 6), z)
    points[..., 2] -= shift
    points[2, 3] = (9.0, 9.0, 1.0)  # a wrong depth that the network marks as invalid
    valid = np.ones(z.shape, dtype=np.bool_)
    valid[2, 3] = False
    prior = decode(points, depth_rule(output="points"), 2.0, None, None, valid)
    np.testing.assert_array_equal(prior.valid, valid)
    np.testing.assert_allclose(prior.depth[valid], 2 * z[valid], rtol=1e-5)


def test_estimated_shift_minimizes_reprojection_error():
    """Check the z-shift from Gauss-Newton, where the linear solution is 8 % smaller."""
    rng = np.random.default_rng(1)
    camera = PinholeCamera(64, 64, 60.0, 60.0, 32.0, 32.0)
    xy = rays(camera, pixel_centers(64, 64))[..., :2]
    z = rng.uniform(0.3, 3, (64, 64))
    points = np.concatenate([xy * (z[..., None] + 0.7), z[..., None]], axis=-1)
    points[..., :2] += rng.normal(0, 0.1, (64, 64, 2))

    def miss(shift):
        return (points[..., :2] / (points[..., 2:] + shift) - xy).ravel()

    best = least_squares(miss, x0=0, method="lm").x[0]
    assert estimate_z_shift(points, xy) == pytest.approx(best, rel=1e-5)


def test_normals_are_turned_into_our_frame_and_normalised():
    value = np.array([[[1.0, 2.0, 2.0], [0.0, 0.0, -1.0]]], dtype=np.float32)
    camera = PinholeCamera(2, 1, 4.0, 4.0, 1.0, 0.5)
    prior = decode_normals(value, NormalsOutput(name="n", axes=(-1, -1, -1)), camera)
    np.testing.assert_allclose(prior.normals[0, 0], [-1 / 3, -2 / 3, -2 / 3], rtol=1e-6)
    assert prior.valid.tolist() == [[True, False]]
    assert prior.variance is None


@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
def test_planes_of_every_rank(layout):
    grid = np.arange(6, dtype=np.float32).reshape(2, 3)
    stacked = np.stack([grid, grid + 10, grid + 20], axis=0 if layout == "NCHW" else -1)
    for tensor in (grid, grid[None], to_planes(grid, layout)[..., 0][None]):
        np.testing.assert_array_equal(to_planes(tensor, layout), grid[..., None])
    for tensor in (stacked, stacked[None]):
        found = to_planes(tensor, layout)
        assert found.shape == (2, 3, 3)
        np.testing.assert_array_equal(found[..., 2], grid + 20)
