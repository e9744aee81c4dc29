"""Tests of ``mpsfm evaluate``."""

from __future__ import annotations

import json
from pathlib import Path

import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app


def evaluate(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(build_app(), ["evaluate", *map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 6
    options.num_points3D = 10
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path / "gt"
    folder.mkdir()
    model.write_text(str(folder))
    return folder


def names_of(folder: Path) -> list[str]:
    model = pycolmap.Reconstruction(str(folder))
    return sorted(image.name for image in model.images.values())


def test_evaluate_truth_against_itself_has_full_auc(truth: Path) -> None:
    code, out, _ = evaluate(truth, truth)
    report = json.loads(out)
    assert code == 0
    assert report["auc"] == pytest.approx({"1": 100, "5": 100, "20": 100}, abs=1e-3)
    assert (report["images"], report["registered"]) == (6, 6)


def test_evaluate_selects_images_by_option_or_file(truth: Path, tmp_path: Path) -> None:
    chosen = names_of(truth)[:3]
    stems = [name.rsplit(".", 1)[0] for name in chosen]
    listed = tmp_path / "names.txt"
    listed.write_text("# three\n" + "\n".join(chosen))
    for arguments in (("--images", ",".join(stems)), ("--image-list", listed)):
        code, out, _ = evaluate(truth, truth, *arguments)
        assert code == 0
        assert (json.loads(out)["images"], json.loads(out)["pairs"]) == (3, 6)
    code, _, err = evaluate(truth, truth, "--images", "a", "--image-list", listed)
    assert code == 2
    assert "exclude each other" in err


def test_evaluate_convention_changes_pairs(truth: Path) -> None:
    report = json.loads(evaluate(truth, truth, "--convention", "vggt")[1])
    assert report["convention"] == "vggt"
    assert report["pairs"] == 15
    code, _, err = evaluate(truth, truth, "--convention", "vgt")
    assert code == 2
    assert "did you mean 'vggt'" in err


def test_evaluate_missing_model_or_image_exits_with_2(truth: Path, tmp_path: Path) -> None:
    code, out, err = evaluate(tmp_path / "nowhere", truth)
    assert (code, out) == (2, "")
    assert "no COLMAP model" in err
    code, _, err = evaluate(truth, truth, "--images", "nobody,noone")
    assert code == 2
    assert "nobody" in err
