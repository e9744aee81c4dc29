"""Tests of ``mpsfm doctor``, ``mpsfm cache`` and the estimate of the remaining time."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.cli.remaining_time import RemainingTimeEstimator, format_remaining_time


def run(*arguments: object) -> str:
    result = CliRunner().invoke(build_app(), [*map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.output


def test_doctor_lists_machine_and_providers(tmp_path: Path) -> None:
    output = run("doctor", "--offline", "--cache", tmp_path)
    for text in ("this machine", "cores", "GPU", "mpsfm-core", "features", "depth", str(tmp_path)):
        assert text in output
    assert "how to improve runs on this machine" in output


def test_doctor_broken_plugin_exits_with_1(tmp_path: Path, install_plugin) -> None:
    install_plugin("mpsfm-broken", "import nothing_of_that_name")
    result = CliRunner().invoke(build_app(), ["doctor", "--offline", "--cache", str(tmp_path)])
    assert result.exit_code == 1
    assert "nothing_of_that_name" in result.output


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Create a cache with an old and a new entry, and old weights."""
    for part, name, days in (
        ("extraction/depth/ab", "old.npz", 40),
        ("extraction/depth/cd", "new.npz", 1),
        ("weights", "network.onnx", 99),
    ):
        file = tmp_path / part / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(bytes(1000))
        then = file.stat().st_mtime - 86400 * days
        os.utime(file, (then, then))
    return tmp_path


def cached_files(cache: Path) -> set[str]:
    return {path.name for path in cache.rglob("*") if path.is_file()}


def test_cache_prune_removes_unused_files(cache: Path) -> None:
    assert "1 files" in run("cache", "prune", "--dry-run", "--cache", cache)
    assert cached_files(cache) == {"old.npz", "new.npz", "network.onnx"}
    run("cache", "prune", "--cache", cache)
    assert cached_files(cache) == {"new.npz", "network.onnx"}
    assert not (cache / "extraction" / "depth" / "ab").exists()
    run("cache", "prune", "--older-than", 0, "--weights", "--cache", cache)
    assert cached_files(cache) == set()


def test_cache_show_lists_parts(cache: Path) -> None:
    output = run("cache", "show", "--cache", cache)
    assert "extraction" in output
    assert "weights" in output


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def simulate_run(
    left: RemainingTimeEstimator, clock: Clock, seconds_a_unit: dict[str, float]
) -> list[float]:
    """Return the relative errors of the estimates in the middle of each stage."""
    units = dict.fromkeys(seconds_a_unit, 10) | {"matching": 45, "verification": 45}
    steps = {name: units[name] * seconds_a_unit[name] for name in units}
    end, errors = clock.now + sum(steps.values()), []
    for name, took in steps.items():
        left.start_stage(name, units[name])
        clock.now += took / 2
        left.update_stage(name, units[name] // 2, units[name])
        told, truth = left.seconds(), end - clock.now
        assert told is not None
        errors.append(told / truth - 1)
        clock.now += took / 2
        left.finish_stage(name)
    return errors


def test_remaining_time_uses_speeds_of_earlier_run(tmp_path: Path) -> None:
    clock = Clock()
    speeds = {"features": 2.0, "matching": 3.0, "verification": 0.1, "depth": 0.1}
    speeds |= {"normals": 0.2, "mapping": 9.0, "dense": 4.0, "results": 1.0, "report": 0.5}
    first = RemainingTimeEstimator(tmp_path, clock)
    assert first.seconds() is None
    simulate_run(first, clock, speeds)
    first.save()
    errors = simulate_run(RemainingTimeEstimator(tmp_path, clock), clock, speeds)
    assert np.abs(errors).max() < 0.15


def test_remaining_time_ignores_disabled_stage(tmp_path: Path) -> None:
    clock = Clock()
    left = RemainingTimeEstimator(tmp_path, clock)
    left.start_stage("features", 10)
    left.finish_stage("features")
    left.start_stage("mapping", 10)
    with_dense = left.seconds()
    left.finish_stage("mapping")
    left.start_stage("results", 10)
    without = left.seconds()
    assert with_dense is not None
    assert without is not None
    assert with_dense > without + 10  # ten images in mapping, and ten in the dense stage
    left.finish_stage("results")
    left.start_stage("report", 10)
    left.finish_stage("report")
    assert left.seconds() == 0


def test_remaining_time_ignores_damaged_timings(tmp_path: Path) -> None:
    (tmp_path / "timings.json").write_text("[1")
    left = RemainingTimeEstimator(tmp_path)
    left.start_stage("features", 10)
    assert left.seconds()


def test_format_remaining_time_rounds_to_units() -> None:
    assert format_remaining_time(None) == ""
    assert format_remaining_time(30) == "less than a minute left"
    assert format_remaining_time(600) == "about 10 min left"
    assert format_remaining_time(7200) == "about 2.0 h left"
