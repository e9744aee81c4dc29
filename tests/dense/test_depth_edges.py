"""Tests of the variance next to depth edges."""

from __future__ import annotations

import numpy as np

from mpsfm_core.dense.depth_edges import add_edge_variance
from mpsfm_core.dense.depth_posterior import LogDepthMap

SHAPE = (40, 60)
STD = 0.01
RADIUS = 3


def raised_std(depth: np.ndarray, num_views: int) -> np.ndarray:
    """Return the std with edge variance of a depth map, confirmed by a number of views."""
    log_depth = np.log(depth).astype(np.float32)
    views = np.full(SHAPE, num_views, np.uint16)
    posterior = LogDepthMap(log_depth, np.full(SHAPE, STD, np.float32))
    result = add_edge_variance(posterior, views, RADIUS)
    np.testing.assert_array_equal(result.log_depth, log_depth)
    return result.log_std


def test_add_edge_variance_next_to_step_depends_on_distance_and_views() -> None:
    depth = np.full(SHAPE, 10.0)
    depth[:, :30] = 5.0
    std = raised_std(depth, num_views=0)
    np.testing.assert_allclose(std[20, 28], np.hypot(STD, 0.5 * 0.5), rtol=1e-3)  # in front
    np.testing.assert_allclose(std[20, 31], np.hypot(STD, 0.5 * 1.0), rtol=1e-3)  # behind
    np.testing.assert_allclose(std[:, : 30 - RADIUS], STD, rtol=1e-6)
    np.testing.assert_allclose(std[:, 30 + RADIUS :], STD, rtol=1e-6)
    np.testing.assert_array_equal(raised_std(depth, num_views=1), std)
    several = [raised_std(depth, views)[20, 31] for views in (1, 2, 3, 6)]
    assert several == sorted(several, reverse=True) and several[-1] < 0.25 * several[0]


def test_add_edge_variance_on_slanted_planes_keeps_std() -> None:
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 1 / (0.05 + 0.002 * row + 0.001 * column)
    np.testing.assert_allclose(raised_std(depth, num_views=0), STD, rtol=0.01)


def test_add_edge_variance_on_thin_structure_keeps_std() -> None:
    depth = np.full(SHAPE, 10.0)
    depth[:, 30] = 5.0
    std = raised_std(depth, num_views=0)
    np.testing.assert_allclose(std[:, 30], STD, rtol=1e-6)
    assert (std[:, [30 - RADIUS, 30 + RADIUS]] > 0.1).all()
