"""``mpsfm doctor``, ``mpsfm cache`` and the estimate of what is left."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.cli.time_left import TimeLeft, in_words


def run(*arguments: object) -> str:
    ended = CliRunner().invoke(build_app(), [*map(str, arguments)])
    assert ended.exit_code == 0, ended.output
    return ended.output


def test_the_doctor_says_what_is_here(tmp_path: Path) -> None:
    said = run("doctor", "--offline", "--cache", tmp_path)
    for text in ("this machine", "cores", "GPU", "mpsfm-core", "features", "depth", str(tmp_path)):
        assert text in said
    assert "what would make runs better here" in said


def test_the_doctor_names_a_broken_plugin(tmp_path: Path, install_plugin) -> None:
    install_plugin("mpsfm-broken", "import nothing_of_that_name")
    ended = CliRunner().invoke(build_app(), ["doctor", "--offline", "--cache", str(tmp_path)])
    assert ended.exit_code == 1
    assert "nothing_of_that_name" in ended.output


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A cache with an old and a new entry, and old weights."""
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


def kept(cache: Path) -> set[str]:
    return {path.name for path in cache.rglob("*") if path.is_file()}


def test_prune_takes_what_was_not_used(cache: Path) -> None:
    assert "1 files" in run("cache", "prune", "--dry-run", "--cache", cache)
    assert kept(cache) == {"old.npz", "new.npz", "network.onnx"}
    run("cache", "prune", "--cache", cache)
    assert kept(cache) == {"new.npz", "network.onnx"}
    assert not (cache / "extraction" / "depth" / "ab").exists()
    run("cache", "prune", "--older-than", 0, "--weights", "--cache", cache)
    assert kept(cache) == set()


def test_show_names_the_parts(cache: Path) -> None:
    said = run("cache", "show", "--cache", cache)
    assert "extraction" in said
    assert "weights" in said


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def go_through(left: TimeLeft, clock: Clock, seconds_a_unit: dict[str, float]) -> list[float]:
    """The error of the estimate in the middle of each step, relative to what is left in truth."""
    units = dict.fromkeys(seconds_a_unit, 10) | {"matching": 45, "verification": 45}
    steps = {name: units[name] * seconds_a_unit[name] for name in units}
    end, errors = clock.now + sum(steps.values()), []
    for name, took in steps.items():
        left.started(name, units[name])
        clock.now += took / 2
        left.progress(name, units[name] // 2, units[name])
        told, truth = left.seconds(), end - clock.now
        assert told is not None
        errors.append(told / truth - 1)
        clock.now += took / 2
        left.finished(name)
    return errors


def test_the_second_run_is_foretold_by_the_first(tmp_path: Path) -> None:
    clock = Clock()
    speeds = {"features": 2.0, "matching": 3.0, "verification": 0.1, "depth": 0.1}
    speeds |= {"normals": 0.2, "mapping": 9.0, "dense": 4.0, "results": 1.0, "report": 0.5}
    first = TimeLeft(tmp_path, clock)
    assert first.seconds() is None
    go_through(first, clock, speeds)
    first.keep()
    errors = go_through(TimeLeft(tmp_path, clock), clock, speeds)
    assert np.abs(errors).max() < 0.15


def test_a_stage_that_is_switched_off_is_not_waited_for(tmp_path: Path) -> None:
    clock = Clock()
    left = TimeLeft(tmp_path, clock)
    left.started("features", 10)
    left.finished("features")
    left.started("mapping", 10)
    with_dense = left.seconds()
    left.finished("mapping")
    left.started("results", 10)
    without = left.seconds()
    assert with_dense is not None
    assert without is not None
    assert with_dense > without + 10  # ten images of mapping, and of dense
    left.finished("results")
    left.started("report", 10)
    left.finished("report")
    assert left.seconds() == 0


def test_a_damaged_record_of_speeds_is_no_worry(tmp_path: Path) -> None:
    (tmp_path / "timings.json").write_text("[1")
    left = TimeLeft(tmp_path)
    left.started("features", 10)
    assert left.seconds()


def test_time_in_words() -> None:
    assert in_words(None) == ""
    assert in_words(30) == "less than a minute left"
    assert in_words(600) == "about 10 min left"
    assert in_words(7200) == "about 2.0 h left"
