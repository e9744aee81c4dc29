"""Tests of reading models, and of identifying their images by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.models import match_names, read_poses


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


def test_folder_without_model_or_with_broken_model_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model"):
        read_poses(tmp_path)
    for name in ("cameras", "images", "points3D", "frames", "rigs"):
        (tmp_path / f"{name}.bin").write_bytes(b"\x01\x00")
    with pytest.raises(InputError, match="the COLMAP model cannot be read"):
        read_poses(tmp_path)


def test_poses_in_memory_are_those_of_the_model() -> None:
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_points3D=20))
    poses = read_poses(model)
    rigid = {image.name: image.cam_from_world() for image in model.images.values()}
    assert poses.keys() == rigid.keys() == read_poses(rigid).keys()
    for name, (rotation, translation) in read_poses(rigid).items():
        np.testing.assert_array_equal(rotation, poses[name][0])
        np.testing.assert_array_equal(translation, poses[name][1])
    with pytest.raises(InputError, match=r"pose of 'a': expected shape \(3, 4\)"):
        read_poses({"a": np.eye(3)})


def test_names_match_without_extension_or_folder() -> None:
    available = ["a/1.jpg", "b/1.jpg", "2.v1.png", "3.jpg", "3.png"]
    assert match_names(["a/1", "2.v1", "3.png"], available) == {
        "a/1": "a/1.jpg",
        "2.v1": "2.v1.png",
        "3.png": "3.png",
    }
    assert match_names(["1", "3", "4.jpg"], available) == {}
    assert match_names(["2.v1"], ["c/d/2.v1.png"]) == {"2.v1": "c/d/2.v1.png"}
    assert match_names(["d/2"], ["c/d/2.png", "c/2.png"]) == {"d/2": "c/d/2.png"}
    assert match_names(["2.v1.jpg"], available) == {"2.v1.jpg": "2.v1.png"}
    # The photo 3.jpg is requested too, so 3.png of the model must not match it.
    assert match_names(["3.jpg", "3.png"], ["3.jpg"]) == {"3.jpg": "3.jpg"}
