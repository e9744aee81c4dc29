"""Tests of calibration files: writing, reading, packaging, and rejected files."""

from __future__ import annotations

from pathlib import Path

import pytest

from mpsfm_core.config import load_config
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.providers.uncertainty.calibration import (
    Calibration,
    DepthCalibration,
    NormalCalibration,
)
from mpsfm_core.providers.uncertainty.calibration_file import (
    CalibrationFile,
    Provenance,
    load_calibration,
)

DEPTH = DepthCalibration(relative_std=0.07, shift=0.2, edge_ratio=1.1, edge_std_scale=2)
NORMALS = NormalCalibration(std_scale=1.5, std_floor_deg=3.0)
PROVENANCE = Provenance(
    provider="files",
    distribution="mpsfm-core 1",
    truth="maps",
    data="9 images",
    date="2026-01-01T00:00:00+00:00",
    core="1",
    images=9,
    pixels=900,
    intervals_95={"relative_std": (0.06, 0.08)},
)


def write(path: Path, calibration: Calibration) -> Path:
    kind = "depth" if isinstance(calibration, DepthCalibration) else "normals"
    CalibrationFile(kind=kind, calibration=calibration, provenance=PROVENANCE).write(path)
    return path


@pytest.mark.parametrize("name", ["a.yaml", "a.json"])
def test_written_calibration_is_read_unchanged(tmp_path: Path, name: str) -> None:
    assert load_calibration(write(tmp_path / name, DEPTH)) == DEPTH
    assert load_calibration(write(tmp_path / name, NORMALS), "normals") == NORMALS


def test_kind_selects_the_calibration_class() -> None:
    values = {"std_scale": 2.0, "use_network_variance": True}
    file = CalibrationFile.model_validate(
        {"kind": "normals", "calibration": values, "provenance": PROVENANCE}
    )
    assert isinstance(file.calibration, NormalCalibration)


def test_configuration_reads_the_calibration_file(tmp_path: Path) -> None:
    write(tmp_path / "depth.yaml", DEPTH)
    config = tmp_path / "run.yaml"
    config.write_text(
        "extends: demo\n"
        "depth: {use: files, options: {directory: maps}, calibration: depth.yaml}\n"
        "normals: {use: files, options: {directory: maps}}\n"
    )
    assert load_config(config).depth.calibration == DEPTH.model_dump(mode="json")


def test_calibration_of_other_kind_raises_with_its_key(tmp_path: Path) -> None:
    write(tmp_path / "depth.yaml", DEPTH)
    config = tmp_path / "run.yaml"
    config.write_text(
        "extends: demo\n"
        "depth: {use: files, options: {directory: maps}}\n"
        "normals:\n  use: files\n  options: {directory: maps}\n  calibration: depth.yaml\n"
    )
    with pytest.raises(ConfigError, match=r"run.yaml:6: .*is a calibration of depth, not of norm"):
        load_config(config)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n", "does not contain a mapping"),
        ("relative_sdt: 0.1\n", "did you mean 'relative_std'"),
        ("kind: depth\ncalibration: 3\nprovenance: {}\n", "must be a mapping"),
        ("a: [\n", "not valid YAML"),
    ],
)
def test_wrong_calibration_files_raise_with_their_name(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"wrong\.yaml") as caught:
        load_calibration(path)
    assert message in str(caught.value)


def test_missing_calibration_file_raises(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_calibration(tmp_path / "nowhere.yaml")
