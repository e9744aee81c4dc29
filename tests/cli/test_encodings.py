"""Tests of names that the terminal cannot print and names that are not UTF-8."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import check_output_folder, find_images
from mpsfm_core.results.colmap_model import write_model

NAMES = ["snow-\u96ea.jpg", "\u03b1.jpg", "\U0001f600.jpg"]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """COLMAP model and images whose names most encodings cannot represent."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=64, height=48, params=[70, 70, 32, 24], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    folder = tmp_path / "scene-\u03a9"
    (folder / "images").mkdir(parents=True)
    for number, name in enumerate(NAMES, start=1):
        Image.new("RGB", (64, 48)).save(folder / "images" / name)
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    write_model(folder / "sparse", model)
    return folder


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "latin-1", "cp437", "utf-8"])
def test_finished_command_succeeds_in_any_terminal(
    model: Path, tmp_path: Path, encoding: str
) -> None:
    command = [sys.executable, "-m", "mpsfm_core", "export", str(model), "--to", "gsplat"]
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    result = subprocess.run(command, env=environment, capture_output=True, check=False, timeout=300)
    assert result.returncode == 0, result.stderr
    assert sorted(p.name for p in (model / "exports" / "gsplat" / "images").iterdir()) == sorted(
        NAMES
    )
    if encoding in ("cp1252", "latin-1"):
        assert r"scene-\u03a9" in result.stdout.decode(encoding)


def test_names_that_are_not_utf8_are_reported_and_skipped(tmp_path: Path, caplog) -> None:
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    latin = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.jpg"))
    try:
        (tmp_path / "a.jpg").rename(latin)
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg")
    with caplog.at_level(logging.WARNING):
        assert find_images(tmp_path) == ["a.jpg", "b.jpg"]
    assert "names are not UTF-8" in caplog.text and r"caf\xe9.jpg" in caplog.text


def test_folder_name_that_is_not_utf8_is_accepted(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    Image.new("RGB", (64, 48)).save(folder / "a.jpg")
    assert find_images(folder) == ["a.jpg"]
    with pytest.raises(InputError, match=r"caf\\xe9.* is not UTF-8"):
        check_output_folder(folder / "out", tmp_path)
