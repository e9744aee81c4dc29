"""Tests of the fusion of known and measured depth."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.dense.depth_posterior import (
    UNKNOWN_LOG_STD,
    LogDepthMap,
    compute_depth_posterior,
    fuse_known_depth,
)

SHAPE = (80, 100)


def observed(rng: np.random.Generator, std: float, stated: float) -> LogDepthMap:
    noise = rng.normal(0, std, SHAPE).astype(np.float32)
    return LogDepthMap(noise, np.full(SHAPE, stated, np.float32))


@pytest.mark.parametrize("known_std", [0.003, 0.01, 0.05])
def test_fuse_known_depth_std_is_calibrated(known_std: float) -> None:
    rng = np.random.default_rng(0)
    measured, known = observed(rng, 0.01, 0.01), observed(rng, known_std, stated=0.1)
    joined = fuse_known_depth(measured, known)
    expected = (0.01**-2 + known_std**-2) ** -0.5
    assert np.abs(joined.log_depth).std() < 1.1 * min(0.01, known_std)
    np.testing.assert_allclose(joined.log_depth.std(), expected, rtol=0.5)
    within = (np.abs(joined.log_depth) < joined.log_std).mean()
    assert 0.6 < within < 0.9


def test_fuse_known_depth_keeps_unmeasured_pixels_unknown() -> None:
    rng = np.random.default_rng(0)
    measured, known = observed(rng, 0.01, 0.01), observed(rng, 0.01, 0.01)
    measured.log_std[:10] = np.inf
    joined = fuse_known_depth(measured, known)
    np.testing.assert_array_equal(joined.known, measured.known)
    measured.log_std[:] = np.inf
    assert fuse_known_depth(measured, known) is measured


def test_fuse_known_depth_ignores_holes() -> None:
    rng = np.random.default_rng(0)
    measured, known = observed(rng, 0.01, 0.01), observed(rng, 0.003, stated=0.1)
    whole = fuse_known_depth(measured, known)
    hole = np.zeros(SHAPE, np.bool_)
    hole[:, 40:] = True
    holed = LogDepthMap(
        np.where(hole, np.float32(1), known.log_depth),
        np.where(hole, np.float32(UNKNOWN_LOG_STD), known.log_std),
    )
    joined = fuse_known_depth(measured, holed)
    np.testing.assert_array_equal(joined.log_depth[hole], measured.log_depth[hole])
    np.testing.assert_allclose(joined.log_std[~hole], whole.log_std[~hole], rtol=0.1)


def test_posterior_keeps_known_depth_next_to_hole() -> None:
    hole = np.zeros(SHAPE, np.bool_)
    hole[22:58, 31:70] = True
    known = LogDepthMap(
        np.zeros(SHAPE, np.float32), np.where(hole, UNKNOWN_LOG_STD, 0.01).astype(np.float32)
    )
    inside = hole & (np.random.default_rng(0).random(SHAPE) < 0.5)
    std = np.where(inside, 0.01, np.inf).astype(np.float32)
    measured = LogDepthMap(np.where(inside, 0.3, 0).astype(np.float32), std)
    joined = compute_depth_posterior(known, measured, correlation_px=20)
    assert np.abs(joined.log_depth[~hole]).max() < 0.005
    assert joined.log_std[~hole].max() < 0.04
    middle = np.s_[32:48, 41:60]
    assert np.abs(joined.log_depth[middle] - 0.3).mean() < 0.05
