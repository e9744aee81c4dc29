"""Tests of robust statistics against numpy."""

from __future__ import annotations

import numpy as np

from mpsfm_core.geometry.statistics import MAD_TO_STD, group_medians


def test_group_medians_match_numpy() -> None:
    rng = np.random.default_rng(0)
    values, groups = rng.normal(size=101), rng.integers(0, 7, 101)
    groups[groups == 3] = 4  # an empty group
    medians = group_medians(values, groups, 8)
    for group in range(8):
        own = values[groups == group]
        if len(own):
            assert medians[group] == np.median(own)
        else:
            assert np.isnan(medians[group])


def test_mad_to_std_normal_errors_gives_std() -> None:
    errors = np.random.default_rng(0).normal(0, 2, 100_000)
    assert np.isclose(MAD_TO_STD * np.median(np.abs(errors)), 2, rtol=0.01)
