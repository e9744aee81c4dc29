"""Tests of container memory limits, read from folders that look like /sys/fs/cgroup."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mpsfm_core.support.control_groups import ControlGroups, MemoryLimit
from mpsfm_core.support.threads import count_cores


def make_groups(root: Path, membership: str, files: dict[str, str]) -> ControlGroups:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (root / "membership").write_text(membership)
    return ControlGroups(root, root / "membership")


@pytest.mark.parametrize(
    ("files", "quota"),
    [
        ({"job/cpu.max": "150000 100000\n"}, 1.5),
        ({"job/cpu.max": "max 100000\n"}, None),
        ({"job/cpu.max": "400000 100000\n", "cpu.max": "200000 100000\n"}, 2.0),
        ({}, None),
        ({"job/cpu.max": "nonsense\n"}, None),
    ],
)
def test_cpu_quota_of_version_2_is_the_smallest_of_all_ancestors(
    tmp_path: Path, files: dict[str, str], quota: float | None
) -> None:
    assert make_groups(tmp_path, "0::/job\n", files).cpu_quota() == quota


def test_cpu_quota_of_version_1_is_read_from_its_controller(tmp_path: Path) -> None:
    files = {
        "cpu,cpuacct/job/cpu.cfs_quota_us": "300000",
        "cpu,cpuacct/job/cpu.cfs_period_us": "100000",
        "cpu,cpuacct/cpu.cfs_quota_us": "-1",
        "cpu,cpuacct/cpu.cfs_period_us": "100000",
    }
    membership = "3:memory:/job\n2:cpu,cpuacct:/job\n"
    assert make_groups(tmp_path, membership, files).cpu_quota() == 3.0


def test_cores_with_quota_of_half_a_core_is_one(tmp_path: Path) -> None:
    groups = make_groups(tmp_path, "0::/\n", {"cpu.max": "50000 100000\n"})
    assert count_cores(groups) == 1


def test_cores_with_large_quota_is_number_of_available_processors(tmp_path: Path) -> None:
    groups = make_groups(tmp_path, "0::/\n", {"cpu.max": "99900000 100000\n"})
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert count_cores(groups) == available


def test_memory_limit_counts_file_cache_as_free(tmp_path: Path) -> None:
    files = {
        "job/memory.max": f"{500 << 20}\n",
        "job/memory.current": f"{300 << 20}\n",
        "job/memory.stat": f"anon 1\ninactive_file {100 << 20}\n",
        "memory.max": "max\n",
        "memory.current": "1\n",
        "memory.stat": "inactive_file 0\n",
    }
    limits = make_groups(tmp_path, "0::/job\n", files).memory_limits()
    assert limits == [MemoryLimit(500 << 20, 300 << 20)]
