"""Tests of ``mpsfm calibrate`` on the sample scene with known errors."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from mpsfm_core.calibration.report import write_report
from mpsfm_core.cli import build_app
from mpsfm_core.config import load_config
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.providers.uncertainty.calibration_file import load_calibration
from mpsfm_core.support.yaml_text import parse_yaml
from tests.calibration.scene_model import write_model

SCENE = Path(__file__).resolve().parents[2] / "examples" / "sample_scene"
DEPTH = ("--ground-truth", SCENE / "gt_depth", "--set", "ground_truth.scale=0.001")
PRIOR = ("--set", f"options.directory={SCENE / 'priors' / 'depth'}")


def run(output: Path, *arguments: object, images: Path = SCENE / "images") -> Result:
    command = ["calibrate", "--provider", "files", "--images", images, "--output", output]
    command += ["--intrinsics", SCENE / "intrinsics.yaml", *arguments]
    return CliRunner().invoke(build_app(), [str(part) for part in command])


def provenance(file: Path) -> dict[str, Any]:
    return parse_yaml(file.read_text(), str(file))["provenance"]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("calibration") / "depth.yaml"
    result = run(file, *PRIOR, *DEPTH)
    assert result.exit_code == 0, result.output
    assert "within 1 std on held-out images" in result.output
    return file


def test_calibrate_sample_scene_finds_overestimated_std(calibrated: Path) -> None:
    """The README of the scene states an RMS of 0.90 for error over declared std, before scaling."""
    calibration = load_calibration(calibrated)
    assert isinstance(calibration, DepthCalibration)
    assert calibration.use_network_variance
    assert 0.5 < calibration.std_scale < 0.9
    assert provenance(calibrated)["metrics"]["before"]["coverage"][0] > 0.8


def test_calibration_file_has_provenance(calibrated: Path) -> None:
    found = provenance(calibrated)
    assert found["provider"] == "files"
    assert found["distribution"].startswith("mpsfm-core ")
    assert found["options"]["directory"] == "depth"
    assert found["data"] == "8 images of sample_scene/images"
    assert found["truth"] == "depth maps in gt_depth"
    assert found["images"] == 8
    assert any("only 8 images" in warning for warning in found["warnings"])
    assert 0.6 < found["metrics"]["after"]["coverage"][0] < 0.76
    assert str(SCENE) not in calibrated.read_text()


def test_config_loads_calibration_file(calibrated: Path, tmp_path: Path) -> None:
    config = tmp_path / "run.yaml"
    config.write_text(
        f"extends: demo\n"
        f"depth: {{use: files, options: {{directory: x}}, calibration: {calibrated}}}\n"
    )
    expected = load_calibration(calibrated).model_dump(mode="json")
    assert load_config(config).depth.calibration == expected


def test_report_has_plots_and_values(calibrated: Path) -> None:
    pytest.importorskip("matplotlib")
    page = calibrated.with_suffix(".report.html").read_text()
    assert page.count("<svg") == 1
    assert not re.search(r"<script|(src|href)=.http|url\(http", page)
    for text in ("Sensitivity", "AUSE", "1.4826 MAD", "add more images", "std_scale"):
        assert text in page
    numbers = json.loads(calibrated.with_suffix(".report.json").read_text())
    assert numbers["provenance"] == provenance(calibrated)
    assert len(numbers["images"]) == 8


def test_plots_are_labeled(calibrated: Path) -> None:
    pytest.importorskip("matplotlib")
    page = calibrated.with_suffix(".report.html").read_text()
    root = ElementTree.fromstring(page[page.index("<svg") : page.index("</svg>") + len("</svg>")])
    groups = {g.get("id"): g for g in root.iter("{http://www.w3.org/2000/svg}g") if g.get("id")}
    plots = [groups[f"axes_{number}"] for number in (1, 2, 3, 4)]
    labels = [
        {"Sensitivity", "ratio of pixels, most certain first", "RMSE / RMSE of all"},
        {"declared std (log depth)", "actual spread (log depth)", "ideal"},
        {"Coverage on held-out images", "standard deviations", "ratio of errors within"},
        {"Coverage by range", "depth (m)", "ratio within 1 std"},
    ]
    for plot, expected in zip(plots, labels, strict=True):
        texts = {"".join(t.itertext()) for t in plot.iter("{http://www.w3.org/2000/svg}text")}
        assert expected <= texts
        assert {"before", "after"} <= {text.split(" ")[0] for text in texts}
    from mpsfm_core.calibration.plots import AFTER, BEFORE

    picture = cv2.imread(str(calibrated.with_suffix(".report.png")))
    for quarter in (
        half for side in np.array_split(picture, 2) for half in np.array_split(side, 2, 1)
    ):
        for color in (BEFORE, AFTER):
            bgr = [int(color[i : i + 2], 16) for i in (5, 3, 1)]
            assert (quarter == bgr).all(axis=2).sum() > 100


def test_report_without_matplotlib_has_hint(
    calibrated: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delitem(sys.modules, "mpsfm_core.calibration.plots", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    report = json.loads(calibrated.with_suffix(".report.json").read_text())
    path, _ = write_report(tmp_path / "again.yaml", report)
    page = path.read_text()
    assert "mpsfm-core[report]" in page
    assert "<svg" not in page
    assert not (tmp_path / "again.report.png").exists()


def test_calibrate_is_deterministic(calibrated: Path, tmp_path: Path) -> None:
    assert run(tmp_path / "again.json", "-q", *PRIOR, *DEPTH).output == ""
    assert load_calibration(tmp_path / "again.json") == load_calibration(calibrated)


def test_calibrate_corrects_std_5_times_too_small(calibrated: Path, tmp_path: Path) -> None:
    wrong = "calibration={std_scale: 0.2, relative_std: 0.0, std_floor: 0.0}"
    assert run(tmp_path / "c.yaml", *PRIOR, *DEPTH, "--set", wrong).exit_code == 0
    assert load_calibration(tmp_path / "c.yaml") == load_calibration(calibrated)
    metrics = provenance(tmp_path / "c.yaml")["metrics"]
    assert metrics["before"]["coverage"][0] < 0.3
    assert metrics["before"]["nll_heavy"] > metrics["after"]["nll_heavy"] + 0.5


def test_calibrate_normals_recovers_the_declared_std(tmp_path: Path) -> None:
    """The README of the scene states an RMS of 0.96 for normal error over declared std."""
    arguments = ["--kind", "normals", "--ground-truth", SCENE / "gt_normals"]
    arguments += ["--set", f"options.directory={SCENE / 'priors' / 'normals'}"]
    result = run(tmp_path / "normals.yaml", *arguments)
    assert result.exit_code == 0, result.output
    calibration = load_calibration(tmp_path / "normals.yaml", "normals")
    assert isinstance(calibration, NormalCalibration)
    assert calibration.use_network_variance
    assert calibration.std_scale == pytest.approx(0.9, abs=0.2)
    after = provenance(tmp_path / "normals.yaml")["metrics"]["after"]
    assert 0.6 < after["coverage"][0] < 0.76


def test_calibrate_skips_masked_pixels_and_missing_truth(tmp_path: Path) -> None:
    shutil.copytree(SCENE / "gt_depth", tmp_path / "gt")
    (tmp_path / "masks").mkdir()
    for path in (tmp_path / "gt").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        depth[:, :320] = 60_000  # The depth of the masked left half is wrong.
        cv2.imwrite(str(path), depth)
        allowed = np.zeros(depth.shape, np.uint8)
        allowed[:, 320:] = 255
        cv2.imwrite(str(tmp_path / "masks" / path.name), allowed)
    (tmp_path / "gt" / "view_7.png").unlink()
    truth = ["--ground-truth", tmp_path / "gt", "--set", "ground_truth.scale=0.001"]
    masks = ["--set", f"inputs.masks={tmp_path / 'masks'}"]
    result = run(tmp_path / "c.yaml", *PRIOR, *truth, *masks)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "c.report.json").read_text())
    assert report["images"] == [f"view_{number}.jpg" for number in range(7)]
    assert report["gross_errors"] < 0.05
    assert report["scale"]["median"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*PRIOR, "--ground-truth", "nowhere"], "nowhere does not exist"),
        ([*PRIOR, "--model", SCENE / "images"], "has no COLMAP model"),
        ([*PRIOR, "--model", SCENE / "gt"], "the model has no points"),
        ([*PRIOR, *DEPTH, "--model", SCENE / "gt"], "true maps or a model for"),
        ([*PRIOR, *DEPTH, "--kind", "depht"], "did you mean 'depth'"),
        ([*PRIOR, *DEPTH, "--alignment", "shift"], "unknown 'shift'"),
        ([*PRIOR, *DEPTH, "--set", "ground_truth.scael=1"], "ground_truth.scael"),
        ([*PRIOR, *DEPTH, "--set", "options.scael=1"], "did you mean 'scale'"),
        (["--kind", "normals", "--model", SCENE / "gt"], "need true normal maps"),
        ([*PRIOR, "--ground-truth", SCENE / "gt"], "has no file for any of the images"),
    ],
)
def test_calibrate_command_wrong_arguments_fail(
    tmp_path: Path, arguments: Sequence[object], message: str
) -> None:
    result = run(tmp_path / "c.yaml", *arguments)
    assert result.exit_code == 2
    assert message in result.output
    assert not (tmp_path / "c.yaml").exists()


def test_calibrate_command_suffix_selects_format(tmp_path: Path) -> None:
    result = run(tmp_path / "calibration", *PRIOR, *DEPTH)
    assert result.exit_code == 2
    assert "must end in .yaml or .json" in result.output


def test_calibrate_with_model_points(calibrated: Path, tmp_path: Path) -> None:
    """Calibration with model points in any unit gives about the same std as with true maps."""
    write_model(SCENE, tmp_path / "model", scale=7.0)
    result = run(tmp_path / "points.yaml", *PRIOR, "--model", tmp_path / "model")
    assert result.exit_code == 0, result.output
    points, maps = load_calibration(tmp_path / "points.yaml"), load_calibration(calibrated)
    assert points.std_scale == pytest.approx(maps.std_scale, rel=0.25)
    found = provenance(tmp_path / "points.yaml")
    assert found["truth"] == "points of a model: model"
    assert "coverage_without_scaling" not in found["metrics"]["after"]
    page = (tmp_path / "points.report.html").read_text()
    assert "depth (unit of the model)" in page and "depth (m)" not in page


@pytest.mark.slow
def test_self_calibration_with_images_only(calibrated: Path, tmp_path: Path) -> None:
    """Self-calibration gives about the same std as calibration with true depth."""
    result = run(tmp_path / "own.yaml", *PRIOR, "--config", "demo", *_normals())
    assert result.exit_code == 0, result.output
    own, true = load_calibration(tmp_path / "own.yaml"), load_calibration(calibrated)
    assert isinstance(own, DepthCalibration)
    assert isinstance(true, DepthCalibration)
    assert own.std_scale == pytest.approx(true.std_scale, rel=0.35)
    assert provenance(tmp_path / "own.yaml")["truth"].startswith("own reconstruction")


def _normals() -> list[str]:
    folder = SCENE / "priors" / "normals"
    return ["--set", "normals.use=files", "--set", f"normals.options.directory={folder}"]
