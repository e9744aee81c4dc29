"""Comparing COLMAP models by image name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mpsfm_core.errors import InputError
from mpsfm_core.evaluation.models import evaluate, match_names, read_poses


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig = 5
    options.num_points3D = 20
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("layout", [".", "sparse", "sparse/0"])
@pytest.mark.parametrize("form", ["text", "binary"])
def test_models_are_found_and_read(
    model: pycolmap.Reconstruction, tmp_path: Path, layout: str, form: str
) -> None:
    folder = tmp_path / layout
    folder.mkdir(parents=True, exist_ok=True)
    getattr(model, f"write_{form}")(str(folder))
    poses = read_poses(tmp_path)
    assert len(poses) == 5
    for image in model.images.values():
        rotation, translation = poses[image.name]
        expected = image.cam_from_world().matrix()
        np.testing.assert_allclose(np.column_stack([rotation, translation]), expected, atol=1e-9)


def test_a_folder_without_a_model_or_with_a_broken_one_is_wrong_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model"):
        read_poses(tmp_path)
    for name in ("cameras", "images", "points3D", "frames", "rigs"):
        (tmp_path / f"{name}.bin").write_bytes(b"\x01\x00")
    with pytest.raises(InputError, match="not a readable COLMAP model"):
        read_poses(tmp_path)


def test_names_match_with_and_without_extension() -> None:
    available = ["a/1.jpg", "b/1.jpg", "2.v1.png", "3.jpg", "3.png"]
    assert match_names(["a/1", "2.v1", "3.png"], available) == {
        "a/1": "a/1.jpg",
        "2.v1": "2.v1.png",
        "3.png": "3.png",
    }
    assert match_names(["1", "3", "4.jpg"], available) == {}
    assert match_names(["2.v1.jpg"], available) == {"2.v1.jpg": "2.v1.png"}
    # 3.jpg is itself asked for, so 3.png must not be taken for it.
    assert match_names(["3.jpg", "3.png"], ["3.jpg"]) == {"3.jpg": "3.jpg"}


def test_the_report_is_plain_data(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_text(str(tmp_path))
    truth = read_poses(tmp_path)
    names = list(truth)
    estimated = {name.rsplit(".", 1)[0] + ".jpeg": truth[name] for name in names[:4]}
    report = json.loads(json.dumps(evaluate(estimated, truth)))
    assert report["convention"] == "paper"
    assert (report["images"], report["registered"], report["pairs"]) == (5, 4, 20)
    assert report["registered_share"] == pytest.approx(0.8)
    assert report["unregistered"] == [names[4]]
    assert report["auc"] == pytest.approx({"1": 60, "5": 60, "20": 60}, abs=1e-3)
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0, abs=1e-6)
    chosen = evaluate(estimated, truth, images=[names[0], names[1].rsplit(".", 1)[0]])
    assert (chosen["images"], chosen["pairs"]) == (2, 2)
    assert chosen["trajectory"] is None


def test_wrong_image_names_are_wrong_input(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_binary(str(tmp_path))
    truth = read_poses(tmp_path)
    with pytest.raises(InputError, match=r"no image .* called nowhere\.jpg"):
        evaluate(truth, truth, images=["nowhere.jpg"])
    with pytest.raises(InputError, match="at least two"):
        evaluate(truth, truth, images=list(truth)[:1])
