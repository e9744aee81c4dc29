"""Tests that programs that expect 8-bit RGB and plain names can read exported images."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.exports.formats import export
from mpsfm_core.results.original_images import export_view, exported_image_name
from mpsfm_core.results.writer import _write_text_model

HEIGHT, WIDTH = 48, 64


def gradient() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x * 3.5, y * 5.0, 200 - x - y], axis=-1).astype(np.uint8)


def write_variant(path: Path, variant: str) -> None:
    rgb = Image.fromarray(gradient())
    if variant == "16-bit":
        cv2.imwrite(str(path), gradient()[..., ::-1].astype(np.uint16) * 257)
    elif variant == "transparent color":
        rgb.save(path, transparency=(0, 0, 0))
    elif variant == "PNG in a name of a JPEG":
        rgb.save(path, format="PNG")
    elif variant == "RGB":
        rgb.save(path)
    elif variant == "RGBA":
        rgb.putalpha(128)
        rgb.save(path)
    else:
        rgb.convert(variant).save(path)


VARIANTS = [
    ("L", ".jpg"), ("CMYK", ".jpg"), ("L", ".png"), ("LA", ".png"), ("RGBA", ".png"), ("P", ".png"),
    ("1", ".png"), ("16-bit", ".png"), ("transparent color", ".png"),
    ("PNG in a name of a JPEG", ".jpg"), ("L", ".JPG"), ("L", ".webp"), ("CMYK", ".tif"),
]  # fmt: skip


@pytest.mark.parametrize(("variant", "suffix"), VARIANTS, ids=lambda value: value)
def test_exported_image_is_8_bit_rgb(tmp_path: Path, variant: str, suffix: str) -> None:
    for name in ("a", "b"):
        write_variant(tmp_path / f"{name}{suffix}", variant)
    images = load_images(tmp_path)
    target = tmp_path / "out" / exported_image_name(images.names[0])
    export_view(images, 0, target)
    with Image.open(target) as exported:
        assert exported.mode == "RGB" and "transparency" not in exported.info
        assert exported.format == ("PNG" if target.suffix == ".png" else "JPEG")
        pixels = np.asarray(exported).astype(int)
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(pixels - images.view(0).image).mean() < 3


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_rgb_image_is_copied_without_loss(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        write_variant(tmp_path / f"{name}{suffix}", "RGB")
    images = load_images(tmp_path)
    export_view(images, 0, tmp_path / "out" / f"a{suffix}")
    assert (tmp_path / "out" / f"a{suffix}").read_bytes() == (tmp_path / f"a{suffix}").read_bytes()


@pytest.fixture
def spaced_model(tmp_path: Path) -> Path:
    """Write a binary model of three images whose names differ only after a space."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=[70, 70, 32, 24], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    (tmp_path / "images").mkdir()
    for number in (1, 2, 3):
        name = f"cam {number}.jpg"
        Image.fromarray(gradient()).save(tmp_path / "images" / name)
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    write_model(tmp_path / "sparse", model)
    return tmp_path


def test_export_as_text_refuses_names_with_spaces(spaced_model: Path) -> None:
    with pytest.raises(InputError, match=r"does not allow spaces in names such as 'cam 1\.jpg'"):
        export(spaced_model, "colmap-text", spaced_model / "out")
    assert not (spaced_model / "out").exists() or not list((spaced_model / "out").iterdir())


@pytest.mark.parametrize("format_name", ["gsplat", "nerfstudio", "colmap-db"])
def test_names_with_spaces_are_kept_by_other_formats(spaced_model: Path, format_name: str) -> None:
    output = spaced_model / "out"
    export(spaced_model, format_name, output)
    names = {"cam 1.jpg", "cam 2.jpg", "cam 3.jpg"}
    if format_name == "gsplat":
        assert set(read_poses(output)) == names
    elif format_name == "nerfstudio":
        assert set(read_poses(output / "transforms.json")) == {f"images/{name}" for name in names}
    else:
        with pycolmap.Database.open(str(output / "database.db")) as database:
            assert {image.name for image in database.read_all_images()} == names


def test_text_model_of_a_run_with_spaces_in_names_is_left_out(
    spaced_model: Path, tmp_path: Path, caplog
) -> None:
    model = pycolmap.Reconstruction(str(spaced_model / "sparse"))
    with caplog.at_level(logging.WARNING):
        _write_text_model(tmp_path / "sparse_text", model)
    assert not (tmp_path / "sparse_text").exists()
    assert "allows no spaces in names (cam 1.jpg)" in caplog.text
