"""Tests of arrays that are in memory up to a limit and on disk beyond."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import mpsfm_core.support.disk_arrays
from mpsfm_core.support.disk_arrays import DiskArrays, current_store, is_on_disk, store_on_disk
from mpsfm_core.support.threads import parallel_map

SIZE = 2**20


def array(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((SIZE // 64, 8), np.float64)


def test_arrays_above_the_memory_limit_are_on_disk(tmp_path: Path) -> None:
    disk = DiskArrays(tmp_path / "made", in_memory=2 * SIZE)
    arrays = [array(seed) for seed in range(4)]
    kept = [disk.store(each) for each in arrays]
    assert [a is b for a, b in zip(arrays, kept, strict=True)] == [True, True, False, False]
    assert [is_on_disk(each) for each in kept] == [False, False, True, True]
    # The files of the arrays are unlinked and have no name.
    assert not list((tmp_path / "made").iterdir())
    for seed, each in enumerate(kept):
        np.testing.assert_array_equal(each, array(seed))


def test_values_outlive_the_memory_that_they_were_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check that each array fills a file, and that a new file frees the memory of earlier
    arrays."""
    monkeypatch.setattr(mpsfm_core.support.disk_arrays, "_MIN_FILE_BYTES", SIZE)
    with ThreadPoolExecutor(4) as pool:
        kept = list(pool.map(DiskArrays(tmp_path, in_memory=0).store, map(array, range(12))))
    for seed, each in enumerate(kept):
        np.testing.assert_array_equal(each, array(seed))


@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.float32])
def test_any_type_and_no_values(tmp_path: Path, dtype: type) -> None:
    disk = DiskArrays(tmp_path, in_memory=0)
    for shape in ((3, 5), (0, 4), (7,)):
        values = np.ones(shape, dtype)
        found = disk.store(values)
        assert found.dtype == dtype and found.shape == shape
        np.testing.assert_array_equal(found, values)


def test_read_only_arrays_stay_read_only(tmp_path: Path) -> None:
    disk = DiskArrays(tmp_path, in_memory=0)
    values = array(0)
    assert disk.store(values).flags.writeable
    values.flags.writeable = False
    assert not disk.store(values).flags.writeable


def test_without_a_disk_all_stay_in_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    disk = DiskArrays(tmp_path / "file", in_memory=0)
    first, second = array(0), array(1)
    assert disk.store(first) is first and disk.store(second) is second
    assert caplog.text.count("depth maps stay in memory") == 1


def test_store_on_disk_is_the_current_store_inside_the_block(tmp_path: Path) -> None:
    values = array(0)
    with store_on_disk(tmp_path, in_memory=0):
        stored = current_store()(values)
    assert stored is not values
    np.testing.assert_array_equal(stored, values)
    assert current_store()(values) is values


def test_threads_of_parallel_map_use_the_current_store(tmp_path: Path) -> None:
    with store_on_disk(tmp_path, in_memory=0):
        stored = parallel_map(lambda seed: current_store()(array(seed)), range(4))
    for seed, each in enumerate(stored):
        assert is_on_disk(each)
        np.testing.assert_array_equal(each, array(seed))
