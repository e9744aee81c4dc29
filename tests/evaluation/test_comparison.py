"""Tests of the statistical comparison of benchmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.comparison import compare_benchmarks, read_benchmark
from mpsfm_core.evaluation.records import BenchmarkRecord, write_record
from mpsfm_core.evaluation.report import ALL_SCENES, build_rows, format_markdown, write_report


def records(
    noise_deg: float,
    *,
    sets: int = 8,
    label: str = "ours",
    seed: int = 0,
    scene: str = "room",
    config: str = "c",
) -> list[BenchmarkRecord]:
    """Return records of five cameras whose orientations have errors of about ``noise_deg``."""
    truth_rng, rng = np.random.default_rng(99), np.random.default_rng(seed)
    made = []
    for number in range(sets):
        rotations = Rotation.random(5, rng=truth_rng).as_matrix()
        truth = {f"{i}.jpg": (rotations[i], truth_rng.normal(size=3)) for i in range(5)}
        turns = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(5, 3))).as_matrix()
        poses = {n: (turns[i] @ r, turns[i] @ t) for i, (n, (r, t)) in enumerate(truth.items())}
        made.append(
            BenchmarkRecord(
                scene, config, "leq10", f"leq10-{number:02d}", label, "", poses, truth, 4, 2.0, 1.0
            )
        )
    return made


def difference(a: list[BenchmarkRecord], b: list[BenchmarkRecord], resamples: int = 400):
    [found] = compare_benchmarks({"ours": a}, {"ours": b}, resamples=resamples)
    return found


def test_compare_benchmarks_large_difference_is_significant() -> None:
    found = difference(records(3.0), records(0.5, seed=1))
    before, after = found.auc[5]
    low, high = found.interval[5]
    assert low < after - before < high
    assert low > 10 and found.p_value[5] < 0.02
    assert found.unit == "sets" and found.sets == 8


def test_compare_benchmarks_equal_sides_are_not_significant() -> None:
    same = difference(records(1.0), records(1.0))
    assert same.interval[5] == (0.0, 0.0) and same.p_value[5] == 1.0


def test_compare_benchmarks_false_positive_rate() -> None:
    # The p-values of the randomization test are uniform for equal benchmarks; the seeds differ from
    # those of other tests.
    p = [
        difference(records(1.0, seed=k), records(1.0, seed=k + 1), resamples=150).p_value[5]
        for k in range(1000, 1120, 2)
    ]
    # The limit is 5 % of 60 tests plus 2.8 standard deviations.
    assert np.mean(np.array(p) < 0.05) < 0.13
    assert 0.3 < np.mean(np.array(p) < 0.5) < 0.7


def test_compare_benchmarks_few_sets_resamples_pairs() -> None:
    found = difference(records(3.0, sets=2), records(0.5, sets=2, seed=1))
    assert found.unit == "pairs" and found.sets == 2
    assert found.interval[20][0] > 0


def test_compare_benchmarks_uses_common_sets() -> None:
    found = difference(records(1.0, sets=8), records(1.0, sets=6, seed=1)[1:])
    assert found.sets == 5
    with pytest.raises(InputError, match="no test set and method in common"):
        compare_benchmarks({"ours": records(1.0)}, {"colmap": records(1.0)})


def test_compare_benchmarks_compares_configurations(tmp_path: Path) -> None:
    for record in records(3.0) + records(0.5, seed=1, config="sift"):
        write_record(tmp_path, record)
    sides = [read_benchmark(f"{tmp_path}:{name}") for name in ("c", "sift")]
    [change] = compare_benchmarks(*sides, resamples=400)
    assert (change.config, change.method, change.sets) == ("c → sift", "ours", 8)
    assert change.interval[5][0] > 10
    with pytest.raises(InputError, match="no test set and method in common"):
        compare_benchmarks(read_benchmark(str(tmp_path)), {"ours": records(1.0, config="demo")})


def test_benchmark_command_compares_folders_and_methods(tmp_path: Path) -> None:
    for record in records(3.0) + records(0.5, seed=1, label="colmap"):
        write_record(tmp_path / "a", record)
    for record in records(0.3, seed=2):
        write_record(tmp_path / "b", record)
    both = ["benchmark", "--compare", str(tmp_path / "a"), str(tmp_path / "b")]
    result = CliRunner().invoke(build_app(), both)
    assert result.exit_code == 0
    assert "| room | c | leq10 | ours | 8 | sets |" in result.stdout
    assert "convention `paper`" in result.stdout and "colmap" not in result.stdout
    within = ["benchmark", "--compare", f"{tmp_path / 'a'}:ours", f"{tmp_path / 'a'}:colmap"]
    result = CliRunner().invoke(build_app(), within)
    assert "ours → colmap" in result.stdout
    with pytest.raises(InputError, match="no configuration or method 'openmvg'; it has"):
        read_benchmark(f"{tmp_path / 'a'}:openmvg")
    with pytest.raises(InputError, match="no benchmark results"):
        read_benchmark(str(tmp_path))


def test_build_rows_pools_errors_and_scenes() -> None:
    first = records(1.0, sets=3)
    lost = BenchmarkRecord(**{**vars(first[0]), "estimated": {}, "error": "RuntimeError: no"})
    rows = build_rows([lost, *first[1:], *records(1.0, sets=2, scene="hall")])
    assert [row.scene for row in rows] == ["room", "hall", ALL_SCENES]
    room = rows[0]
    assert (room.sets, room.failed, room.pairs) == (3, 1, 12)
    assert room.registered == pytest.approx(2 / 3)
    assert room.auc[20] < rows[1].auc[20]
    assert rows[2].sets == 5
    pooled = (3 * room.auc[5] + 2 * rows[1].auc[5]) / 5  # All test sets have equal size.
    assert rows[2].auc[5] == pytest.approx(pooled)
    text = format_markdown(rows)
    assert "### all scenes, configuration `c`" in text and "| 67% | 1.00 | 1 |" in text


def test_report_lists_failures(tmp_path: Path) -> None:
    good, other = records(1.0, sets=2)
    lost = BenchmarkRecord(
        **{**vars(other), "estimated": {}, "error": "RuntimeError: 3 < 5 points"}
    )
    write_report(tmp_path, [good, lost])
    line = "room / c / leq10-01 / ours: RuntimeError: 3 < 5 points"
    assert f"### Failed\n\n- {line}\n" in (tmp_path / "report.md").read_text()
    assert f"<li>{line.replace('<', '&lt;')}</li>" in (tmp_path / "report.html").read_text()
    write_report(tmp_path, [good, other])
    assert "### Failed" not in (tmp_path / "report.md").read_text()
