"""Tests of which images share a camera, and of the shared initial focal length."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mpsfm_core.inputs.camera_sharing import CameraGuess, guess_cameras
from mpsfm_core.inputs.image_header import ImageHeader
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import InputOptions

SIZE = (3000, 2000)
F35, PIXELS_X, PIXELS_Y = 0xA405, 0xA002, 0xA003


def make_header(camera: str = "", f35: float = 0, width: float = 0) -> ImageHeader:
    tags = {F35: f35, PIXELS_X: width, PIXELS_Y: width / 1.5}
    return ImageHeader(None, 1, tags, camera=camera)


def guess(
    headers: dict[str, ImageHeader],
    sizes: dict[str, tuple[int, int]] | None = None,
    **options: Any,
) -> dict[str, CameraGuess]:
    sizes = dict.fromkeys(headers, SIZE) | (sizes or {})
    return guess_cameras(headers, sizes, InputOptions(**options))


def numbers(cameras: dict[str, CameraGuess]) -> list[int]:
    return [camera.number for camera in cameras.values()]


@pytest.mark.parametrize(
    ("second", "shares"),
    [
        (make_header("model A", 36), True),
        (make_header("model B", 36), False),
        (make_header("model A", 50), False),
        (make_header("model A", 36, width=6000), False),
        (make_header("", 36), False),
    ],
    ids=["equal", "other model", "other zoom", "crop of a larger photo", "no model"],
)
def test_guess_cameras_auto_shares_by_exif(second: ImageHeader, shares: bool) -> None:
    cameras = guess({"one/a.jpg": make_header("model A", 36), "two/b.jpg": second})
    assert (len(set(numbers(cameras))) == 1) == shares


def test_guess_cameras_auto_without_exif_shares_by_folder_and_size() -> None:
    headers = {name: make_header() for name in ("a.jpg", "b.jpg", "c.jpg", "side/d.jpg")}
    cameras = guess(headers, {"c.jpg": (2000, 3000)})
    assert numbers(cameras) == [1, 1, 2, 3]
    assert cameras["a.jpg"] == CameraGuess(1, 1.2 * 3000, "default")


@pytest.mark.parametrize(
    ("camera_per", "expected"),
    [("image", [1, 2, 3, 4]), ("folder", [1, 1, 2, 2]), ("set", [1, 1, 1, 1])],
)
def test_guess_cameras_option_overrides_exif(camera_per: str, expected: list[int]) -> None:
    headers = {
        "one/a.jpg": make_header("model A", 36),
        "one/b.jpg": make_header("model B", 40),
        "two/c.jpg": make_header("model B", 44),
        "two/d.jpg": make_header(),
    }
    assert numbers(guess(headers, camera_per=camera_per)) == expected


def test_guess_cameras_per_set_takes_the_median_focal_length() -> None:
    headers = {name: make_header("A", f35) for name, f35 in (("a", 30), ("b", 36), ("c", 60))}
    cameras = guess(headers | {"d": make_header()}, camera_per="set")
    assert {camera.source for camera in cameras.values()} == {"exif"}
    assert cameras["d"].focal_px == pytest.approx(3000 * 36 / 36)


def test_guess_cameras_per_set_warns_of_several_sizes(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        cameras = guess({"a": make_header(), "b": make_header()}, {"b": (20, 10)}, camera_per="set")
    assert numbers(cameras) == [1, 2]
    assert "2 sizes" in caplog.text


def test_load_images_reads_make_model_and_lens(tmp_path: Path) -> None:
    for name, model in (("a.jpg", "ELPH 300"), ("b.jpg", "ELPH 300"), ("c.jpg", "D60")):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", model
        exif.get_ifd(0x8769).update({0xA405: 36, 0xA434: "28 mm"})
        Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(tmp_path / name, exif=exif)
    found = load_images(tmp_path)
    assert [image.camera.camera_id for image in found] == [1, 1, 2]
    apart = load_images(tmp_path, options=InputOptions(camera_per="image"))
    assert [image.camera.camera_id for image in apart] == [1, 2, 3]
