"""Tests of the benchmark on a small scene: run, resume, failures, report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation import methods
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.methods import MethodRun, run_method, run_methods
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_errors_deg
from mpsfm_core.evaluation.records import read_record, read_records
from mpsfm_core.evaluation.report import CLOUD_METRICS
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.evaluation.conftest import CAMERA

pytestmark = pytest.mark.slow  # The benchmark starts processes that compile the mapper's kernels.

CONFIG = """
features:
  use: sift
matcher:
  use: mutual-nearest
depth:
  use: files
  options: {{directory: {depth}, scale: 0.001, relative_std: 0.02}}
normals:
  use: from-depth
runtime:
  workers: 1
  cache_dir: {cache}
"""


@pytest.fixture(scope="module")
def config(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("config")
    path = folder / "sift.yaml"
    path.write_text(CONFIG.format(depth=scene_folder / "gt_depth", cache=folder / "cache"))
    return path


@pytest.fixture(scope="module")
def output(
    scene_folder: Path, config: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str, str]:
    """Finished run of ``mpsfm benchmark``, with its output text."""
    folder = tmp_path_factory.mktemp("benchmark") / "out"
    result = CliRunner().invoke(build_app(), arguments(scene_folder, config, folder))
    assert result.exit_code == 0, result.stderr
    return folder, result.stdout, result.stderr


def arguments(scene: Path, config: Path, folder: Path) -> list[str]:
    settings = f"--config {config} --prior sensor,degraded --sets all --peers colmap -o {folder}"
    settings += " --distance 0.02 --distance 0.1"
    return ["benchmark", str(scene), *settings.split()]


def test_report_lists_methods_and_convention(output) -> None:
    folder, out, _ = output
    report = json.loads((folder / "report.json").read_text())["conventions"]
    assert set(report) == {"paper", "models", "colmap", "vggt"}
    rows = {row["method"]: row for row in report["paper"]["rows"]}
    assert set(rows) == {"ours-sensor", "ours-degraded", "colmap"}
    for row in rows.values():
        assert (row["scene"], row["config"], row["bucket"]) == ("room", "sift", "all")
        assert row["registered"] == 1.0 and row["failed"] == 0 and row["cpu_seconds"] > 0
    assert rows["ours-sensor"]["auc"]["5"] > 80
    assert (folder / "report.md").read_text() == out
    assert "convention `paper`: ordered pairs" in out
    assert "| all | 1 | ours-sensor |" in out
    assert "ordered pairs" in (folder / "report.html").read_text()


def test_report_dense_columns_need_true_depth(output) -> None:
    folder, out, _ = output
    report = json.loads((folder / "report.json").read_text())["conventions"]["paper"]
    rows = {row["method"]: row["dense"] for row in report["rows"]}
    assert rows["colmap"] is None
    exact, degraded = rows["ours-sensor"], rows["ours-degraded"]
    assert exact["sets"] == 1 and exact["abs_rel"] < degraded["abs_rel"] < 0.05
    assert exact["accuracy"]["0.1"] > 0.9 and exact["completeness"]["0.1"] > 0.9
    for found in (exact, degraded):
        assert found["f1"].keys() == found["accuracy"].keys() == {"0.02", "0.1"}
        assert found["f1"]["0.02"] < found["f1"]["0.1"]
    lines = {line.split(" | ")[2]: line for line in out.splitlines() if line.startswith("| ")}
    assert lines["method"].endswith("| failed | AbsRel | 0.02 m | 0.1 m |")
    shares = " / ".join(f"{100 * exact[key]['0.1']:.0f}" for key in CLOUD_METRICS)
    assert lines["ours-sensor"].endswith(f"| {shares} |")
    assert f"| {exact['abs_rel']:.3f} |" in lines["ours-sensor"]
    assert lines["colmap"].endswith("|  |  |  |  |")
    page = (folder / "report.html").read_text()
    assert "<th>AbsRel</th><th>0.02 m</th>" in page and f"<td>{shares}</td>" in page


def test_benchmark_without_true_depth_renders_held_out_images(
    scene_folder: Path, config: Path, tmp_path: Path
) -> None:
    scene = tmp_path / scene_folder.name
    shutil.copytree(scene_folder, scene, ignore=shutil.ignore_patterns("gt_depth"))
    settings = f"--config {config} --sets all --peers none -o {tmp_path / 'out'}"
    settings += " --set dense.hold_out_every=3"
    result = CliRunner().invoke(build_app(), ["benchmark", str(scene), *settings.split()])
    assert result.exit_code == 0, result.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())["conventions"]["paper"]
    (row,) = report["rows"]
    found = row["dense"]
    assert found.keys() == {"sets", "covered", "psnr", "ssim"}
    assert found["covered"] > 0.5 and found["psnr"] > 15 and 0 < found["ssim"] <= 1
    assert "| failed | held out: covered | PSNR, dB | SSIM |" in result.stdout
    cells = f"| {found['covered']:.0%} | {found['psnr']:.1f} | {found['ssim']:.2f} |"
    assert cells in result.stdout


def test_report_recall_curves_match_errors(output) -> None:
    folder, _, _ = output
    page = (folder / "report.html").read_text()
    drawing = ElementTree.fromstring(
        page[page.index("<svg") : page.index("</svg>") + len("</svg>")]
    )
    texts = [element.text for element in drawing.iter("text")]
    for text in ("ratio of pairs", "error of a pair up to", "0%", "100%", "20°", "colmap"):
        assert texts.count(text) == 1
    curves = [element.get("points", "").split() for element in drawing.iter("polyline")]
    assert len(curves) == 3
    record = read_record(folder / "runs" / "room" / "sift" / "all-00" / "ours-sensor.json")
    errors = pose_errors_deg(record.estimated, record.truth, CONVENTIONS["paper"])
    (first,) = (curve for curve, label in zip(curves, texts[-3:], strict=True) if "sensor" in label)
    end = 260 * (1 - (errors <= 20).mean())
    assert first[0] == "0.0,260.0" and first[-1] == f"440.0,{end:.1f}"
    assert len(first) == 2 + 2 * (errors <= 20).sum()


def test_records_contain_poses(output) -> None:
    folder, _, _ = output
    record = read_record(folder / "runs" / "room" / "sift" / "all-00" / "ours-sensor.json")
    assert set(record.estimated) == set(record.truth)
    for rotation, translation in record.estimated.values():
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert translation.shape == (3,)
    assert record.pairs >= 4 and not record.error


def test_run_benchmark_second_run_uses_records(output, scene_folder: Path, config: Path) -> None:
    folder, out, _ = output
    times = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/*/*/*.json")}
    assert len(times) == 3
    result = CliRunner().invoke(build_app(), arguments(scene_folder, config, folder))
    assert result.exit_code == 0 and result.stdout == out
    assert result.stderr.count("images, cached") == 3
    assert {path: path.stat().st_mtime_ns for path in times} == times


def test_run_benchmark_repeats_changed_or_damaged_runs(
    output, scene_folder: Path, config: Path
) -> None:
    folder, _, _ = output
    damaged = folder / "runs" / "room" / "sift" / "all-00" / "colmap.json"
    damaged.write_text(damaged.read_text()[:100])
    known = {}
    plan = BenchmarkPlan(
        (scene_folder,),
        (str(config),),
        ("all",),
        ("sensor",),
        ("colmap",),
        ("mapping.max_components=9",),
    )
    run_benchmark(plan, folder, on_record=lambda record, old: known.update({record.label: old}))
    assert known == {"ours-sensor": False, "colmap": False}
    assert read_record(damaged).label == "colmap"
    known.clear()
    run_benchmark(plan, folder, on_record=lambda record, old: known.update({record.label: old}))
    assert known == {"ours-sensor": True, "colmap": True}


def test_run_benchmark_is_independent_of_workers(
    output, scene_folder: Path, config: Path, tmp_path
) -> None:
    plan = BenchmarkPlan((scene_folder,), (str(config),), None, ("sensor",), ("colmap",), workers=2)
    records = {r.name: r for r in run_benchmark(plan, tmp_path / "out")}
    assert len(records) == 6
    # The first test set contains the image pairs of all test sets, so its matches are the same.
    folder, _, _ = output
    for record in read_records(folder):
        if record.label == "colmap":
            for name, (rotation, _) in record.estimated.items():
                other, _ = records[record.name].estimated[name]
                np.testing.assert_allclose(rotation, other, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"peers": ("colmapp",)}, "no peer 'colmapp'; did you mean 'colmap'"),
        ({"priors": ("laser",)}, "no prior 'laser'"),
        ({"buckets": ("leq5",)}, "no bucket 'leq5'"),
    ],
)
def test_run_benchmark_unknown_name_raises(
    scene_folder: Path, config: Path, tmp_path, change, message
):
    plan = BenchmarkPlan((scene_folder,), (str(config),), **change)
    with pytest.raises(InputError, match=message):
        run_benchmark(plan, tmp_path)


def test_run_benchmark_equal_scene_names_raise(scene_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="same name"):
        run_benchmark(BenchmarkPlan((scene_folder, scene_folder)), tmp_path)


def small_task(method: str = "ours") -> MethodRun:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 10.0))
    return MethodRun(method, method, problem, MapperOptions())


def test_run_method_exception_becomes_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: object) -> None:
        raise RuntimeError("no memory")

    task = small_task("colmap")
    monkeypatch.setattr(methods, "run_peer", fails)
    outcome = run_method(task)
    assert outcome.error == "RuntimeError: no memory" and not outcome.models


def test_run_methods_survives_crash() -> None:
    dies = MethodRun("dies", "ours", Deadly(), MapperOptions())  # type: ignore[arg-type]
    outcomes = {
        task.label: outcome for task, outcome in run_methods([dies, small_task("colmap")], 1)
    }
    assert outcomes["dies"].error == "its process died"
    assert len(outcomes["colmap"].models[0]) == 3


class Deadly:
    """Object whose unpickling ends the process, like a failed assertion in native code."""

    def __reduce__(self) -> tuple:
        import os

        return os._exit, (11,)
