"""Tests of benchmark records from models of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.external_results import read_external_records
from mpsfm_core.evaluation.pose_auc import CONVENTIONS
from mpsfm_core.evaluation.records import read_record, write_record
from mpsfm_core.evaluation.scene_folder import EvaluationSet, SceneFolder
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.results.transforms_json import write_transforms


def scene_of(model: pycolmap.Reconstruction, path: Path) -> SceneFolder:
    truth = reconstruction_poses(model)
    names = tuple(truth)
    sets = (EvaluationSet("minimal", 0, names[:3]), EvaluationSet("all", 0, names))
    return SceneFolder(path / "room", truth, sets)


def moved(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Transform poses to another world frame and unit, which programs choose freely."""
    copy = pycolmap.Reconstruction(model)
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3]))
    copy.transform(pycolmap.Sim3d(2.5, turn, np.array([1.0, 2, 3])))
    return copy


def write_text(model: pycolmap.Reconstruction, folder: Path) -> None:
    folder.mkdir(parents=True)
    model.write_text(str(folder))


def test_external_records_read_colmap_models(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    scene = scene_of(model, tmp_path)
    for item in scene.sets:
        write_text(moved(model), tmp_path / "theirs" / "room" / item.name / "sparse" / "0")
    records = read_external_records("theirs", tmp_path / "theirs", scene, scene.sets, "benchmark")
    assert [len(record.estimated) for record in records] == [3, 5]
    for record in records:
        assert record.errors_deg(CONVENTIONS["paper"]).max() < 1e-4
        write_record(tmp_path / "out", record)
        assert read_record(tmp_path / "out" / record.file).label == "theirs"


def test_external_records_keep_several_models(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    scene = scene_of(model, tmp_path)
    small = pycolmap.Reconstruction(model)
    for image in sorted(small.images)[2:]:
        small.deregister_frame(small.images[image].frame_id)
    write_text(small, tmp_path / "theirs" / "all-00" / "sparse" / "0")
    write_text(model, tmp_path / "theirs" / "all-00" / "sparse" / "1")
    (record,) = read_external_records(
        "theirs", tmp_path / "theirs", scene, scene.sets[1:], "benchmark"
    )
    assert (len(record.estimated), [len(other) for other in record.others]) == (5, [2])


def test_external_records_read_transforms(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    scene = scene_of(model, tmp_path)
    (tmp_path / "theirs").mkdir()
    files = {image.name: f"images/{image.name}" for image in model.images.values()}
    write_transforms(tmp_path / "theirs" / "transforms.json", moved(model), files)
    (record,) = read_external_records(
        "nerfstudio", tmp_path / "theirs", scene, scene.sets[1:], "benchmark"
    )
    assert len(record.estimated) == 5
    assert record.errors_deg(CONVENTIONS["paper"]).max() < 1e-4


def test_external_records_missing_model_is_failed(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    scene = scene_of(model, tmp_path)
    write_text(model, tmp_path / "theirs" / "all-00")
    first, second = read_external_records(
        "theirs", tmp_path / "theirs", scene, scene.sets, "benchmark"
    )
    assert first.error == "no model of this set"
    assert (first.errors_deg(CONVENTIONS["paper"]) == 180).all()
    assert not second.error
    with pytest.raises(
        InputError, match=r"no model of any test set of room; expected as .*minimal-00"
    ):
        read_external_records("theirs", tmp_path / "out", scene, scene.sets, "benchmark")


@pytest.mark.parametrize("text", ["theirs", "a/b=.", "theirs=nowhere", "ours-sensor=.", "colmap=."])
def test_benchmark_command_wrong_result_fails(text: str, tmp_path: Path) -> None:
    arguments = ["benchmark", "scene", "-o", str(tmp_path), "--result", text]
    ended = CliRunner().invoke(build_app(), arguments)
    assert ended.exit_code == 2
    assert text in ended.stderr
