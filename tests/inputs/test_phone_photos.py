"""Tests of files of phones and cameras: HEIC, raw photos, GPS positions, panoramas."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
import tifffile
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.gps import read_gps
from mpsfm_core.inputs.image_decoding import decode_rgb
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.images import load_images


def picture(width: int = 96, height: int = 64) -> np.ndarray:
    """Return an image whose red increases to the right and green downwards."""
    x, y = np.meshgrid(np.linspace(20, 235, width), np.linspace(20, 235, height))
    return np.stack([x, y, np.full_like(x, 128)], axis=-1).astype(np.uint8)


def exif(orientation: int = 1, **gps: object) -> Image.Exif:
    data = Image.Exif()
    data[0x0112] = orientation
    data.get_ifd(0x8769)[0xA405] = 28  # focal length for 35 mm film
    place = {
        **{1: "S", 2: (33.0, 51.0, 24.12), 3: "E", 4: (151.0, 12.0, 54.0)},
        **{5: b"\x00", 6: 12.5, 31: 4.0},
    }
    data.get_ifd(0x8825).update({int(k): v for k, v in {**place, **gps}.items()})
    return data


def write_dng(path: Path, rgb: np.ndarray) -> None:
    """Write an uncompressed RGGB mosaic of a camera whose color matrix is the identity."""
    mosaic = np.empty(rgb.shape[:2], np.uint16)
    linear = (rgb / 255.0) ** 2.2 * 65535
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, column::2] = linear[row::2, column::2, channel]
    identity = np.stack([np.eye(3, dtype=int).ravel(), np.ones(9, int)], axis=1).ravel().tolist()
    tags = [
        (33421, "H", 2, (2, 2), False),
        (33422, "B", 4, bytes([0, 1, 1, 2]), False),
        (50706, "B", 4, bytes([1, 4, 0, 0]), False),
        (50708, "s", 0, "Test", False),
        (50717, "I", 1, 65535, False),
        (50721, "2i", 9, tuple(identity), False),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), False),
        (50778, "H", 1, 21, False),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


def check_axes(rgb: np.ndarray) -> None:
    rows, columns = rgb.shape[:2]
    left, right = rgb[:, : columns // 4], rgb[:, -columns // 4 :]
    assert right[..., 0].mean() > left[..., 0].mean() + 60
    assert rgb[-rows // 4 :, :, 1].mean() > rgb[: rows // 4, :, 1].mean() + 60


@pytest.mark.parametrize("orientation", [1, 6])
def test_heic_photos(tmp_path: Path, orientation: int) -> None:
    for number in range(2):
        stored = Image.fromarray(picture())
        pillow_heif.from_pillow(stored).save(
            tmp_path / f"{number}.HEIC", exif=exif(orientation).tobytes(), quality=90
        )
    images = load_images(tmp_path)
    upright = (96, 64) if orientation == 1 else (64, 96)
    assert images[0].original_size == upright
    assert images[0].focal_source == "exif"
    assert images[0].gps is not None
    assert images.view(0).image.shape[:2] == upright[::-1]
    if orientation == 1:
        check_axes(images.view(0).image)


def test_heic_photo_named_jpg_is_decoded(tmp_path: Path) -> None:
    for number in range(2):
        path = tmp_path / f"{number}.heic"
        pillow_heif.from_pillow(Image.fromarray(picture())).save(path)
        path.rename(path.with_suffix(".jpg"))
    check_axes(load_images(tmp_path).view(1).image)


def test_raw_photos(tmp_path: Path) -> None:
    for number in range(2):
        write_dng(tmp_path / f"{number}.dng", picture())
    images = load_images(tmp_path)
    assert images[0].original_size == (96, 64)
    check_axes(images.view(0).image)


@pytest.mark.parametrize(("module", "name"), [("pillow_heif", "a.heic"), ("rawpy", "a.dng")])
def test_a_missing_library_is_named(monkeypatch, tmp_path: Path, module: str, name: str) -> None:
    path = tmp_path / name
    if name == "a.heic":
        pillow_heif.from_pillow(Image.fromarray(picture())).save(path)
    else:
        write_dng(path, picture())
    data = path.read_bytes()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'mpsfm-core\[(heic|raw)\]'"):
        decode_rgb(data, read_header(data), path)
    monkeypatch.undo()
    assert importlib.import_module(module)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_gps_positions(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(picture()).save(path, exif=exif())
    position = read_gps(path.read_bytes())
    assert position is not None
    assert position.latitude == pytest.approx(-33.8567, abs=1e-5)
    assert position.longitude == pytest.approx(151.215, abs=1e-5)
    assert (position.altitude, position.std_m) == (12.5, 4.0)


DAMAGED_GPS = {
    "nowhere": {"2": (0.0, 0.0, 0.0), "4": (0.0, 0.0, 0.0)},
    "beyond the pole": {"2": (233.0, 0.0, 0.0)},
    "two numbers": {"2": (33.0, 51.0)},
    "one number": {"4": (151.0,)},
}


@pytest.mark.parametrize("damage", DAMAGED_GPS)
def test_damaged_gps_positions_are_none(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(picture()).save(path, exif=exif(**DAMAGED_GPS[damage]))
    assert read_gps(path.read_bytes()) is None


def test_damaged_gps_bytes_do_not_raise(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(picture()).save(path, exif=exif())
    data = path.read_bytes()
    start = data.index(b"Exif\x00\x00")
    for place in range(start, start + 250):
        read_gps(data[:place])
        read_gps(data[:place] + b"\xff" + data[place + 1 :])
        read_gps(data[:place] + b"\x00" + data[place + 1 :])


def test_panoramas_are_refused_by_name(tmp_path: Path) -> None:
    xmp = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    for number in range(2):
        Image.fromarray(picture(128, 64)).save(tmp_path / f"{number}.jpg", xmp=xmp)
    with pytest.raises(InputError, match=r"0\.jpg is a panorama \(equirectangular\)"):
        load_images(tmp_path)
