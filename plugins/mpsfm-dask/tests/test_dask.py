"""Tests of the Dask executor on a real cluster of several processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from mpsfm_dask.executor import DaskExecutor

from mpsfm_core.data.errors import ConfigError
from mpsfm_core.testing import executor_contract

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask's threads warn when Python exits


@pytest.fixture(scope="module")
def executor() -> Iterator[DaskExecutor]:
    executor = DaskExecutor({"workers": 2})
    yield executor
    executor.close()


def test_executor_passes_contract_of_items(executor: DaskExecutor, tmp_path: Path) -> None:
    executor_contract.check_items(executor, tmp_path / "items")


def test_executor_passes_contract_of_errors(executor: DaskExecutor) -> None:
    executor_contract.check_errors(executor)


def test_lost_worker_loses_no_results(executor: DaskExecutor, tmp_path: Path) -> None:
    executor_contract.check_lost_worker(executor, tmp_path / "items")


@pytest.mark.slow
def test_extraction(tmp_path: Path) -> None:
    executor_contract.check_extraction("dask", {"workers": 2}, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 3])
def test_mapping_in_parts(tmp_path: Path, workers: int) -> None:
    executor_contract.check_mapping_in_parts("dask", {"workers": workers}, tmp_path)


@pytest.mark.slow  # starts clusters
def test_mapping_in_parts_with_a_killed_worker(tmp_path: Path) -> None:
    options = {"workers": 2}
    executor_contract.check_mapping_in_parts("dask", options, tmp_path, kills_worker=True)


@pytest.mark.slow
def test_dense_stage(tmp_path: Path) -> None:
    executor_contract.check_dense_stage("dask", {"workers": 2}, tmp_path)


@pytest.mark.slow
def test_a_failing_provider(tmp_path: Path) -> None:
    executor_contract.check_failing_provider("dask", {"workers": 2}, tmp_path)


def test_executor_passes_contract_of_options() -> None:
    executor_contract.check_options(DaskExecutor)


def test_missing_cluster_raises() -> None:
    with pytest.raises(ConfigError, match="no Dask workers at"):
        DaskExecutor({"address": "tcp://127.0.0.1:9", "timeout_s": 1})
