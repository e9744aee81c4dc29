"""What ties between pairs of views say of their scales."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.dense.scale_errors import Ties, scale_stds, ties_of_photo

SHAPE = 60, 80
LEFT = np.broadcast_to(np.arange(80) < 40, SHAPE)


def one_tie(a: int, b: int, std: float) -> Ties:
    precision = np.array([[0, 1], [1, 0]]) / std**2
    return Ties([a, b], np.array([100, 100]), precision)


def end(other: int) -> Ties:
    return Ties([other], np.array([100]), np.zeros((1, 1)))


def differences(left: float, right: float, shared: int = 0) -> dict[int, np.ndarray]:
    """Views 1 and 2 confirm the left and the right half, and some columns in the middle both."""
    maps = {1: np.where(LEFT, left, np.nan), 2: np.where(LEFT, np.nan, right)}
    maps[1][:, 40 : 40 + shared], maps[2][:, 40 - shared : 40] = left, right
    return {view: map_.astype(np.float32) for view, map_ in maps.items()}


def test_errors_add_up_along_a_chain() -> None:
    # pairs 0-1, 1-2, 2-3, tied in photos 1 and 2
    chain = {0: end(1), 1: one_tie(0, 2, 0.03), 2: one_tie(1, 3, 0.04), 3: end(2)}
    found = scale_stds(chain)
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
    around, along = scale_stds(ring), scale_stds(chain)
    # variance of a closed random walk beside its mean: s^2 (n^2 - 1) / (12 n)
    assert around[7] == pytest.approx(0.02 * ((count**2 - 1) / (12 * count)) ** 0.5)
    assert np.ptp(list(around.values())) < 1e-9
    assert along[0] > 1.9 * around[0]


def test_one_pair_and_photos_without_a_pair_have_no_other_scale() -> None:
    alone = Ties([], np.zeros(0, np.int64), np.zeros((0, 0)))
    assert scale_stds({0: end(1), 1: end(0), 2: alone}) == {0: 0, 1: 0, 2: 0}
    assert scale_stds({2: alone}) == {2: 0}


def test_known_depth_ties_regions_as_well_as_it_fits_there() -> None:
    change = np.random.default_rng(0).normal(0, np.where(LEFT, 0.03, 0.04), SHAPE)
    usable = np.ones(SHAPE, np.bool_)
    ties = ties_of_photo(differences(0, 0), usable, change.astype(np.float32), 20)
    assert ties.others == [1, 2] and ties.pixels.tolist() == [2400, 2400]
    assert ties.precision[0, 1] ** -0.5 == pytest.approx(0.05, rel=0.05)


def test_shared_pixels_tie_pairs_as_well_as_both_agree_there() -> None:
    change = np.full(SHAPE, 0.1, np.float32)
    usable = np.ones(SHAPE, np.bool_)
    ties = ties_of_photo(differences(-0.001, 0.001, shared=10), usable, change, 20)
    # 60 x 20 shared pixels are three squares of 20 x 20
    assert ties.precision[0, 1] == pytest.approx(3 / 0.002**2 + 1 / 0.02, rel=1e-4)
    fewer = ties_of_photo(differences(-0.001, 0.001, shared=3), usable, change, 20)
    assert fewer.precision[0, 1] == pytest.approx(1 / 0.02)
    masked = ties_of_photo(differences(0, 0), LEFT, change, 20)
    assert masked.others == [1]


def test_simulated_scales_are_within_their_std_as_often_as_normal_ones() -> None:
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(60):
        steps = rng.normal(0, 0.03, 19)
        chain = {k: one_tie(k - 1, k + 1, 0.03) for k in range(1, 20)}
        chain |= {0: end(1), 20: end(19)}
        scales = np.concatenate([[0], np.cumsum(steps)])
        found = scale_stds(chain)
        inside.append(abs(scales[0] - scales.mean()) < found[0])
        inside.append(abs(scales[-1] - scales.mean()) < found[20])
    assert 0.55 < np.mean(inside) < 0.8
