"""Tests of the Ray executor on a real cluster of several processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from mpsfm_core.testing import executor_contract

pytest.importorskip("ray", reason="Ray is not installed: pip install ray")
from mpsfm_ray.executor import RayExecutor

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's threads warn when Python exits


class TestOneCluster:
    """Tests that share one Ray cluster, because Ray supports only one per process."""

    @pytest.fixture(scope="class")
    def executor(self) -> Iterator[RayExecutor]:
        executor = RayExecutor({"workers": 2})
        yield executor
        executor.close()

    def test_executor_passes_contract_of_items(self, executor: RayExecutor, tmp_path: Path) -> None:
        executor_contract.check_items(executor, tmp_path / "items")

    def test_executor_passes_contract_of_errors(self, executor: RayExecutor) -> None:
        executor_contract.check_errors(executor)

    def test_lost_worker_loses_no_results(self, executor: RayExecutor, tmp_path: Path) -> None:
        executor_contract.check_lost_worker(executor, tmp_path / "items")


@pytest.mark.slow  # starts clusters
def test_extraction(tmp_path: Path) -> None:
    executor_contract.check_extraction("ray", {"workers": 2}, tmp_path)


@pytest.mark.slow  # starts clusters
@pytest.mark.parametrize("workers", [1, 3])
def test_mapping_in_parts(tmp_path: Path, workers: int) -> None:
    executor_contract.check_mapping_in_parts("ray", {"workers": workers}, tmp_path)


@pytest.mark.slow  # starts clusters
def test_mapping_in_parts_with_a_killed_worker(tmp_path: Path) -> None:
    options = {"workers": 2}
    executor_contract.check_mapping_in_parts("ray", options, tmp_path, kills_worker=True)


@pytest.mark.slow  # starts a cluster
def test_dense_stage(tmp_path: Path) -> None:
    executor_contract.check_dense_stage("ray", {"workers": 2}, tmp_path)


@pytest.mark.slow  # starts clusters
def test_a_failing_provider(tmp_path: Path) -> None:
    executor_contract.check_failing_provider("ray", {"workers": 2}, tmp_path)


def test_executor_passes_contract_of_options() -> None:
    executor_contract.check_options(RayExecutor)
