"""Depth that was known and depth that was measured, joined."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.dense.posterior import Observed, with_known

SHAPE = (80, 100)


def observed(rng: np.random.Generator, std: float, stated: float) -> Observed:
    noise = rng.normal(0, std, SHAPE).astype(np.float32)
    return Observed(noise, np.full(SHAPE, stated, np.float32))


@pytest.mark.parametrize("known_std", [0.003, 0.01, 0.05])
def test_the_stated_std_is_that_of_the_joined_depth(known_std: float) -> None:
    """Whatever std the known depth declares."""
    rng = np.random.default_rng(0)
    measured, known = observed(rng, 0.01, 0.01), observed(rng, known_std, stated=0.1)
    joined = with_known(measured, known)
    expected = (0.01**-2 + known_std**-2) ** -0.5
    assert np.abs(joined.log_depth).std() < 1.1 * min(0.01, known_std)
    np.testing.assert_allclose(joined.log_depth.std(), expected, rtol=0.5)
    within = (np.abs(joined.log_depth) < joined.log_std).mean()
    assert 0.6 < within < 0.9


def test_what_was_not_measured_stays_unknown() -> None:
    rng = np.random.default_rng(0)
    measured, known = observed(rng, 0.01, 0.01), observed(rng, 0.01, 0.01)
    measured.log_std[:10] = np.inf
    joined = with_known(measured, known)
    np.testing.assert_array_equal(joined.known, measured.known)
    measured.log_std[:] = np.inf
    assert with_known(measured, known) is measured
