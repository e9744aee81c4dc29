"""Tests of resizing, masking and edges of prior maps."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.extraction.priors import prior_maps as priors
from mpsfm_core.geometry import pixel_centers, rays

FULL, GRID = (96, 64), (48, 32)
CAMERA = PinholeCamera(*FULL, 90.0, 92.0, 47.0, 33.0)
PLANE = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])


def plane_depth(size: tuple[int, int]) -> np.ndarray:
    return -2.0 / (rays(CAMERA.resized(*size), pixel_centers(*size)) @ PLANE)


def depth_prior(depth: np.ndarray, valid: np.ndarray | None = None) -> DepthPrior:
    return DepthPrior.from_arrays(depth, (0.05 * depth) ** 2, valid)


def normal_prior(shape: tuple[int, int], valid: np.ndarray | None = None) -> NormalPrior:
    normals = np.broadcast_to(PLANE, (*shape, 3))
    return NormalPrior.from_arrays(normals, np.full(shape, 0.01), valid)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((1600, 1067), (387, 258)), ((1067, 1600), (258, 387)), ((100, 100), (387, 387))],
)
def test_integration_grid_has_aspect_ratio_of_image(size, expected) -> None:
    assert priors.integration_grid(size, 387) == expected
    assert priors.integration_grid((100_000, 10), 387) == (387, 1)


# Area averaging of a plane is exact for integer ratios only.
@pytest.mark.parametrize(
    ("grid", "tolerance"), [(GRID, 2e-5), ((150, 100), 2e-5), ((70, 40), 1e-3)]
)
def test_resize_depth_of_plane_is_exact(grid, tolerance) -> None:
    resized = priors.resize_depth(depth_prior(plane_depth(FULL)), grid)
    assert resized.shape == grid[::-1] and resized.valid.all()
    inner = np.s_[3:-3, 3:-3]  # upsampling repeats the border
    assert np.allclose(resized.depth[inner], plane_depth(grid)[inner], rtol=tolerance)
    assert np.allclose(np.sqrt(resized.variance), 0.05 * resized.depth, rtol=1e-3)


def test_resize_depth_averages_pixel_areas() -> None:
    """A pixel of the small grid covers exactly four pixels of the large grid."""
    depth = np.full(FULL[::-1], 2.0)
    depth[10:12, 20:22] = 4.0
    small = priors.resize_depth(depth_prior(depth), GRID)
    assert np.argwhere(small.depth > 3.9).tolist() == [[5, 10]]


@pytest.mark.parametrize("grid", [GRID, (150, 100), (70, 40)])
def test_resize_depth_is_valid_only_if_all_pixels_are(grid) -> None:
    valid = np.ones(FULL[::-1], dtype=np.bool_)
    valid[20, 30] = False
    depth = plane_depth(FULL)
    depth[20, 30] = 1e6
    resized = priors.resize_depth(depth_prior(depth, valid), grid)
    row, column = np.argwhere(~resized.valid).mean(axis=0) + 0.5
    assert (column * 96 / grid[0], row * 64 / grid[1]) == pytest.approx((30.5, 20.5), abs=1.0)
    assert not resized.valid.all()
    inner = np.zeros_like(resized.valid)
    inner[3:-3, 3:-3] = True
    usable = resized.valid & inner
    assert np.allclose(resized.depth[usable], plane_depth(grid)[usable], rtol=1e-3)
    normals = priors.resize_normals(normal_prior((64, 96), valid), grid)
    assert np.array_equal(normals.valid, resized.valid)


def test_resize_to_same_grid_returns_same_prior() -> None:
    prior = depth_prior(plane_depth(FULL))
    assert priors.resize_depth(prior, FULL) is prior
    normals = normal_prior((64, 96))
    assert priors.resize_normals(normals, FULL) is normals


def test_resize_without_variance() -> None:
    assert priors.resize_depth(DepthPrior.from_arrays(plane_depth(FULL)), GRID).variance is None
    bare = NormalPrior.from_arrays(np.broadcast_to(PLANE, (64, 96, 3)))
    assert priors.resize_normals(bare, GRID).variance is None


def test_resize_normals_averages_and_normalizes() -> None:
    left, right = np.array([0.6, 0, -0.8]), np.array([-0.6, 0, -0.8])
    normals = np.empty((64, 96, 3))
    normals[:, 0::2], normals[:, 1::2] = left, right
    variance = np.full((64, 96), 0.01)
    variance[0::2] = 0.03
    resized = priors.resize_normals(NormalPrior.from_arrays(normals, variance), GRID)
    assert np.allclose(resized.normals, [0, 0, -1], atol=1e-6)
    assert np.allclose(resized.variance, 0.02)


def test_resize_mask_takes_nearest_pixel() -> None:
    mask = np.zeros((64, 96), dtype=np.bool_)
    mask[:, 48:] = True
    allowed = priors.resize_mask(mask, GRID)
    assert not allowed[:, :24].any() and allowed[:, 24:].all()
    restricted = priors.mask_depth(depth_prior(plane_depth(GRID)), allowed)
    assert np.array_equal(restricted.valid, allowed)
    assert np.array_equal(priors.mask_normals(normal_prior((32, 48)), allowed).valid, allowed)


def test_inflate_edge_variance_on_both_sides_of_edges() -> None:
    depth = np.full((32, 48), 2.0)
    depth[:, 20:] = 2.1
    depth[:, 30:] = 2.1 * 1.01
    found = priors.inflate_edge_variance(normal_prior((32, 48)), depth_prior(depth), 1.015)
    distrusted = found.variance == priors.EDGE_VARIANCE
    assert np.argwhere(distrusted.all(axis=0)).ravel().tolist() == [19, 20]
    assert distrusted.sum() == 2 * 32


def test_inflate_edge_variance_ignores_steps_to_invalid_pixels() -> None:
    valid = np.ones((32, 48), dtype=np.bool_)
    valid[:, 20] = False
    prior = depth_prior(np.full((32, 48), 2.0), valid)
    found = priors.inflate_edge_variance(normal_prior((32, 48)), prior, 1.015)
    assert np.allclose(found.variance, 0.01)
