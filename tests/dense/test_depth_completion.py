"""Tests of depth completion at pixels without stereo measurement."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.dense.depth_posterior import LogDepthMap, compute_depth_posterior

SHAPE = (120, 160)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
PLANE = -np.log(0.5 + 0.002 * X + 0.001 * Y).astype(np.float32)
"""Log depth of a slanted wall."""
BOX = (abs(X - 120) < 20) & (abs(Y - 60) < 30)
LEFT = X < 80


def complete_depth(known: np.ndarray, truth: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Complete known log depth from noisy measurements of the true depth inside a mask."""
    noise = np.random.default_rng(0).normal(0, 0.003, SHAPE)
    measured = np.where(where, 0.003, np.inf).astype(np.float32)
    std = np.full(SHAPE, 0.25, np.float32)
    found = LogDepthMap((truth + noise).astype(np.float32), measured)
    return compute_depth_posterior(
        LogDepthMap(known.astype(np.float32), std), found, correlation_px=40
    ).log_depth


def test_completion_extends_plane_where_known_depth_is_poor() -> None:
    known = PLANE + 0.3 * np.cos(X / 40) * np.cos(Y / 50)
    error = np.abs(complete_depth(known, PLANE, LEFT) - PLANE)
    assert np.abs(known - PLANE)[~LEFT].mean() > 0.1
    assert error[~LEFT].mean() < 0.03


def test_completion_keeps_depth_edges_of_known_depth() -> None:
    truth = PLANE - 0.5 * BOX
    known = truth + 0.02 * np.sin(X / 40) * np.cos(Y / 50)
    error = np.abs(complete_depth(known, truth, LEFT) - truth)
    assert error[BOX].mean() < 0.03
    assert error[~LEFT].mean() < 0.03


def test_completion_keeps_accurate_known_depth() -> None:
    rough = np.random.default_rng(1).normal(0, 0.05, (12, 16)).repeat(10, 0).repeat(10, 1)
    truth = PLANE + rough
    error = np.abs(complete_depth(truth + 0.001 * np.sin(X / 30), truth, LEFT) - truth)
    assert error[~LEFT].mean() < 0.003


@pytest.mark.parametrize("count", [0, 1, 40])
def test_completion_ignores_isolated_measurements(count: int) -> None:
    where = np.zeros(SHAPE, np.bool_)
    where.ravel()[np.linspace(0, where.size - 1, count).astype(int)] = True
    truth = PLANE - 0.2
    np.testing.assert_array_equal(complete_depth(PLANE, truth, where)[~where], PLANE[~where])
