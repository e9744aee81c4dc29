"""What ties between pairs of views say of their scales."""

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
"""Precision of a tie that says hardly anything."""


def one_tie(a: int, b: int, std: float, known_std: float = 1.0) -> ScaleConstraints:
    """Of two pairs by the pixels that they share."""
    precision = np.array([[0, 1], [1, 0]]) / std**2
    return ScaleConstraints([a, b], np.array([100, 100]), precision, np.full(2, WEAK), known_std)


def end(other: int, known: float = WEAK, known_std: float = 1.0) -> ScaleConstraints:
    """One pair, and how well known depth is tied to it."""
    return ScaleConstraints(
        [other], np.array([100]), np.zeros((1, 1)), np.array([known]), known_std
    )


def no_pair(known_std: float = 1.0) -> ScaleConstraints:
    return ScaleConstraints([], np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros(0), known_std)


def differences(left: float, right: float, shared: int = 0) -> dict[int, np.ndarray]:
    """Views 1 and 2 confirm the left and the right half, and some columns in the middle both."""
    maps = {1: np.where(LEFT, left, np.nan), 2: np.where(LEFT, np.nan, right)}
    maps[1][:, 40 : 40 + shared], maps[2][:, 40 - shared : 40] = left, right
    return {view: map_.astype(np.float32) for view, map_ in maps.items()}


def test_errors_add_up_along_a_chain() -> None:
    # pairs 0-1, 1-2, 2-3, tied in photos 1 and 2
    chain = {0: end(1), 1: one_tie(0, 2, 0.03), 2: one_tie(1, 3, 0.04), 3: end(2)}
    found = estimate_scale_stds(chain)
    # x1 = a, x2 = a + b: less the mean, with b of 0.04 and a of 0.03
    variance = np.array(
        [0.03**2 * 4 / 9 + 0.04**2 / 9, 0.03**2 / 9 + 0.04**2 / 9, 0.03**2 / 9 + 0.04**2 * 4 / 9]
    )
    assert found[0] == pytest.approx(variance[0] ** 0.5)
    assert found[1] == pytest.approx(variance[:2].mean() ** 0.5)
    assert found[3] == pytest.approx(variance[2] ** 0.5)


def test_a_ring_is_surer_than_the_chain_and_long_ones_are_solved() -> None:
    count = 400
    ring = {k: one_tie((k - 1) % count, (k + 1) % count, 0.02) for k in range(count)}
    chain = ring | {0: end(1), count - 1: end(count - 2)}
    around, along = estimate_scale_stds(ring), estimate_scale_stds(chain)
    # variance of a closed random walk beside its mean: s^2 (n^2 - 1) / (12 n)
    assert around[7] == pytest.approx(0.02 * ((count**2 - 1) / (12 * count)) ** 0.5)
    assert np.ptp(list(around.values())) < 1e-9
    assert along[0] > 1.9 * around[0]


def test_one_pair_has_no_other_scale() -> None:
    assert estimate_scale_stds({0: end(1), 1: end(0)}) == pytest.approx({0: 0, 1: 0}, abs=1e-6)
    assert estimate_scale_stds({2: no_pair()}) == {2: 0}


def test_what_no_pair_joins_hangs_on_what_known_depth_declares() -> None:
    exact, std = 1e9, 0.2
    groups = {view: end(view ^ 1, exact, std) for view in range(4)}  # pairs 0-1 and 2-3
    # a map is off by sqrt(1.5) std, as those of a pair hang together by half; a pair is where the
    # mean of its maps is, and half as far from the mean of both pairs as they are from each other
    expected = std * (1.5 / 2 / 2) ** 0.5
    assert list(estimate_scale_stds(groups).values()) == pytest.approx([expected] * 4, rel=1e-3)
    alone = estimate_scale_stds({0: end(1, exact, std), 1: end(0, exact, std), 2: no_pair(std)})
    assert alone[0] == pytest.approx(0, abs=1e-4)
    assert alone[2] == pytest.approx(std * (1 + 1.5 / 2) ** 0.5, rel=1e-3)


def test_known_depth_ties_regions_as_well_as_it_fits_there() -> None:
    change = np.random.default_rng(0).normal(0, np.where(LEFT, 0.03, 0.04), SHAPE)
    ties = measure_scale_constraints(differences(0, 0), change.astype(np.float32), 0.25, 20)
    assert ties.others == [1, 2] and ties.pixels.tolist() == [2400, 2400]
    assert ties.known_std == 0.25 and not ties.shared.any()
    np.testing.assert_allclose(ties.known**-0.5, [0.03, 0.04], rtol=0.05)


def test_shared_pixels_tie_pairs_no_better_than_both_agree_there() -> None:
    change = np.full(SHAPE, 0.1, np.float32)
    ties = measure_scale_constraints(differences(-0.001, 0.001, shared=10), change, 0.25, 20)
    # however many pixels: they all say that the two scales differ by 0.002
    assert ties.shared[0, 1] ** -0.5 == pytest.approx(0.002, rel=1e-4)
    fewer = measure_scale_constraints(differences(-0.001, 0.001, shared=3), change, 0.25, 20)
    assert not fewer.shared.any()  # less than one square
    left = {j: np.where(LEFT, map_, np.nan) for j, map_ in differences(0, 0).items()}
    masked = measure_scale_constraints(left, change, 0.25, 20)
    assert masked.others == [1]


def test_pairs_that_confirm_the_same_pixels_are_as_sure_as_their_own_errors() -> None:
    rng, std, count = np.random.default_rng(2), 0.01, 5
    errors = rng.normal(0, std, (count + 1, *SHAPE))
    errors -= errors.mean(axis=(1, 2), keepdims=True)  # scales that differ by nothing
    seen = {j: (errors[j] - errors[0]).astype(np.float32) for j in range(1, count + 1)}
    none = np.zeros(SHAPE, np.float32)
    ties = measure_scale_constraints(seen, none, 0.25, 1)
    # precision of count observations of one thing with a common error that tells nothing:
    # 1 / std^2 for each pixel, less their mean
    expected = SHAPE[0] * SHAPE[1] / std**2 / count
    off_diagonal = ties.shared[~np.eye(count, dtype=np.bool_)]
    np.testing.assert_allclose(off_diagonal, expected, rtol=0.1)


def test_simulated_scales_are_within_their_std_as_often_as_normal_ones() -> None:
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(60):
        steps = rng.normal(0, 0.03, 19)
        chain = {k: one_tie(k - 1, k + 1, 0.03) for k in range(1, 20)}
        chain |= {0: end(1), 20: end(19)}
        scales = np.concatenate([[0], np.cumsum(steps)])
        found = estimate_scale_stds(chain)
        inside.append(abs(scales[0] - scales.mean()) < found[0])
        inside.append(abs(scales[-1] - scales.mean()) < found[20])
    assert 0.55 < np.mean(inside) < 0.8
