"""Tests of the scale uncertainty of image pairs."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.dense.scale_uncertainty import (
    ScaleConstraints,
    estimate_scale_stds,
    measure_scale_constraints,
)

SHAPE = 60, 80
LEFT = np.broadcast_to(np.arange(80) < 40, SHAPE)


WEAK = 1e-7
"""Precision of a constraint with negligible influence."""


def pair_constraint(a: int, b: int, std: float, known_std: float = 1.0) -> ScaleConstraints:
    """Constrain the scales of two pairs by shared pixels."""
    precision = np.array([[0, 1], [1, 0]]) / std**2
    return ScaleConstraints([a, b], np.array([100, 100]), precision, np.full(2, WEAK), known_std)


def end_constraint(other: int, known: float = WEAK, known_std: float = 1.0) -> ScaleConstraints:
    """Return an image with one pair, constrained to its known depth."""
    return ScaleConstraints(
        [other], np.array([100]), np.zeros((1, 1)), np.array([known]), known_std
    )


def no_pair(known_std: float = 1.0) -> ScaleConstraints:
    return ScaleConstraints([], np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros(0), known_std)


def differences(left: float, right: float, shared: int = 0) -> dict[int, np.ndarray]:
    """Return depth differences of two views: each confirms one half and `shared` columns."""
    maps = {1: np.where(LEFT, left, np.nan), 2: np.where(LEFT, np.nan, right)}
    maps[1][:, 40 : 40 + shared], maps[2][:, 40 - shared : 40] = left, right
    return {view: map_.astype(np.float32) for view, map_ in maps.items()}


def test_scale_variance_adds_up_along_chain() -> None:
    # Images 1 and 2 constrain the scales of the pairs 0-1, 1-2 and 2-3.
    chain = {
        0: end_constraint(1),
        1: pair_constraint(0, 2, 0.03),
        2: pair_constraint(1, 3, 0.04),
        3: end_constraint(2),
    }
    found = estimate_scale_stds(chain)
    # The log scales are 0, a and a + b minus their mean, with a std of 0.03 for a and 0.04 for b.
    variance = np.array(
        [0.03**2 * 4 / 9 + 0.04**2 / 9, 0.03**2 / 9 + 0.04**2 / 9, 0.03**2 / 9 + 0.04**2 * 4 / 9]
    )
    assert found[0] == pytest.approx(variance[0] ** 0.5)
    assert found[1] == pytest.approx(variance[:2].mean() ** 0.5)
    assert found[3] == pytest.approx(variance[2] ** 0.5)


def test_scale_std_of_ring_is_below_chain() -> None:
    count = 400
    ring = {k: pair_constraint((k - 1) % count, (k + 1) % count, 0.02) for k in range(count)}
    chain = ring | {0: end_constraint(1), count - 1: end_constraint(count - 2)}
    around, along = estimate_scale_stds(ring), estimate_scale_stds(chain)
    # A closed random walk has the variance s^2 (n^2 - 1) / (12 n) relative to its mean.
    assert around[7] == pytest.approx(0.02 * ((count**2 - 1) / (12 * count)) ** 0.5)
    assert np.ptp(list(around.values())) < 1e-9
    assert along[0] > 1.9 * around[0]


def test_scale_std_of_single_pair_is_zero() -> None:
    assert estimate_scale_stds({0: end_constraint(1), 1: end_constraint(0)}) == pytest.approx(
        {0: 0, 1: 0}, abs=1e-6
    )
    assert estimate_scale_stds({2: no_pair()}) == {2: 0}


def test_scale_std_of_separate_pairs_is_declared_std() -> None:
    exact, std = 1e9, 0.2
    groups = {view: end_constraint(view ^ 1, exact, std) for view in range(4)}  # pairs 0-1 and 2-3
    # The scale std of a depth map is sqrt(1.5) std, because the correlation in a pair is 0.5. A
    # pair has the mean scale of its two depth maps, and half the scale difference of the pairs.
    expected = std * (1.5 / 2 / 2) ** 0.5
    assert list(estimate_scale_stds(groups).values()) == pytest.approx([expected] * 4, rel=1e-3)
    alone = estimate_scale_stds(
        {0: end_constraint(1, exact, std), 1: end_constraint(0, exact, std), 2: no_pair(std)}
    )
    assert alone[0] == pytest.approx(0, abs=1e-4)
    assert alone[2] == pytest.approx(std * (1 + 1.5 / 2) ** 0.5, rel=1e-3)


def test_known_depth_constraint_uses_regional_error() -> None:
    change = np.random.default_rng(0).normal(0, np.where(LEFT, 0.03, 0.04), SHAPE)
    constraints = measure_scale_constraints(differences(0, 0), change.astype(np.float32), 0.25, 20)
    assert constraints.sources == [1, 2] and constraints.pixels.tolist() == [2400, 2400]
    assert constraints.known_std == 0.25 and not constraints.shared.any()
    np.testing.assert_allclose(constraints.known**-0.5, [0.03, 0.04], rtol=0.05)


def test_shared_pixel_constraint_is_bounded_by_mean_difference() -> None:
    change = np.full(SHAPE, 0.1, np.float32)
    constraints = measure_scale_constraints(differences(-0.001, 0.001, shared=10), change, 0.25, 20)
    # The std is 0.002 for any number of pixels, because all pixels differ in scale by 0.002.
    assert constraints.shared[0, 1] ** -0.5 == pytest.approx(0.002, rel=1e-4)
    fewer = measure_scale_constraints(differences(-0.001, 0.001, shared=3), change, 0.25, 20)
    assert not fewer.shared.any()  # The shared pixels are fewer than one observation.
    left = {j: np.where(LEFT, map_, np.nan) for j, map_ in differences(0, 0).items()}
    masked = measure_scale_constraints(left, change, 0.25, 20)
    assert masked.sources == [1]


def test_shared_pixel_constraint_excludes_common_error() -> None:
    rng, std, count = np.random.default_rng(2), 0.01, 5
    errors = rng.normal(0, std, (count + 1, *SHAPE))
    errors -= errors.mean(axis=(1, 2), keepdims=True)  # equal scales
    seen = {j: (errors[j] - errors[0]).astype(np.float32) for j in range(1, count + 1)}
    none = np.zeros(SHAPE, np.float32)
    constraints = measure_scale_constraints(seen, none, 0.25, 1)
    # The precision is that of `count` observations whose common error cancels.
    expected = SHAPE[0] * SHAPE[1] / std**2 / count
    off_diagonal = constraints.shared[~np.eye(count, dtype=np.bool_)]
    np.testing.assert_allclose(off_diagonal, expected, rtol=0.1)


def test_scale_std_of_simulated_chain_is_calibrated() -> None:
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(60):
        steps = rng.normal(0, 0.03, 19)
        chain = {k: pair_constraint(k - 1, k + 1, 0.03) for k in range(1, 20)}
        chain |= {0: end_constraint(1), 20: end_constraint(19)}
        scales = np.concatenate([[0], np.cumsum(steps)])
        found = estimate_scale_stds(chain)
        inside.append(abs(scales[0] - scales.mean()) < found[0])
        inside.append(abs(scales[-1] - scales.mean()) < found[20])
    assert 0.55 < np.mean(inside) < 0.8
