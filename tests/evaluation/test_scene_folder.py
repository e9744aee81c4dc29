"""Tests of reading scene folders."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.scene_folder import read_scene
from tests.evaluation.conftest import NAMES, POSES


def test_read_scene_returns_sets_and_poses(scene_folder: Path) -> None:
    scene = read_scene(scene_folder)
    assert [item.name for item in scene.sets] == [
        "all-00",
        "triplets_20-40-00",
        "triplets_20-40-01",
    ]
    assert scene.sets[0].images == tuple(NAMES)
    assert scene.sets[2].images == tuple(NAMES[2:])
    rotation, translation = scene.truth["0003.png"]
    np.testing.assert_allclose(np.column_stack([rotation, translation]), POSES[3], atol=1e-9)
    assert scene.depth == scene_folder / "gt_depth"
    assert scene.intrinsics == scene_folder / "gt"  # The scene folder has no intrinsics.yaml.


def test_select_sets_by_bucket_and_group(scene_folder: Path) -> None:
    scene = read_scene(scene_folder)
    assert len(scene.select_sets(None)) == 3
    assert [item.bucket for item in scene.select_sets(["triplets"])] == ["triplets/20-40"] * 2
    assert [item.bucket for item in scene.select_sets(["all"])] == ["all"]
    with pytest.raises(InputError, match="no bucket 'minimal'; the scene has all, triplets/20-40"):
        scene.select_sets(["minimal"])


@pytest.fixture
def copy(scene_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(scene_folder, tmp_path / "copy")
    return tmp_path / "copy"


def test_read_scene_without_sets_has_one_set(copy: Path) -> None:
    (copy / "testsets.yaml").unlink()
    assert [item.images for item in read_scene(copy).sets] == [tuple(NAMES)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("all: [[0000, 0009]]", "no photo with a true pose is called 0009"),
        ("all: [[0000]]", "set 0 needs two or more images"),
        ("- [0000, 0001]", "must map buckets"),
        ("all: [[0000, 0001]", "cannot be read"),
    ],
)
def test_read_scene_wrong_sets_raise(copy: Path, text: str, message: str) -> None:
    (copy / "testsets.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        read_scene(copy)


def test_read_scene_without_images_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="photos must be in images"):
        read_scene(tmp_path)
