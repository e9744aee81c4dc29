"""Tests of robust statistics against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.geometry.statistics import MAD_TO_STD, group_medians, pooled_median


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


@pytest.mark.parametrize("sizes", [[1], [2], [3, 0, 4], [50_001, 1, 2999]])
def test_pooled_median_many_arrays_equals_numpy(sizes: list[int]) -> None:
    rng = np.random.default_rng(len(sizes))
    arrays = [rng.exponential(0.05, size).astype(np.float32) for size in sizes]
    arrays[0][0] = 0.0
    assert pooled_median(lambda: arrays) == float(np.median(np.concatenate(arrays)))


def test_pooled_median_no_values_is_none() -> None:
    assert pooled_median(lambda: [np.zeros(0, np.float32)]) is None
