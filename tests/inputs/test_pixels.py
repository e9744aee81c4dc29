"""Tests that every format, bit depth and orientation is decoded to upright 8-bit RGB."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_decoding import decode_rgb, orient, read_bytes
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.masks import decode_mask

ORIENTATION = 0x0112

# Transform from stored to upright image, as the EXIF standard defines each orientation.
UPRIGHT: dict[int, Callable[[UInt8], UInt8]] = {
    1: lambda image: image,
    2: lambda image: cv2.flip(image, 1),
    3: lambda image: cv2.rotate(image, cv2.ROTATE_180),
    4: lambda image: cv2.flip(image, 0),
    5: lambda image: cv2.transpose(image),
    6: lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    7: lambda image: cv2.rotate(cv2.transpose(image), cv2.ROTATE_180),
    8: lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
}


def decode(path: Path) -> UInt8:
    data = read_bytes(path)
    return decode_rgb(data, read_header(data), path)


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_orient_equals_the_exif_standard(orientation: int, photo: UInt8) -> None:
    assert np.array_equal(orient(photo, orientation), UPRIGHT[orientation](photo))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_orientation_of_every_format_is_applied(
    suffix, order, orientation, photo, write_image
) -> None:
    path = write_image(f"a{suffix}", tags={ORIENTATION: orientation}, order=order)
    header = read_header(path.read_bytes())
    assert header.orientation == orientation
    decoded = decode(path).astype(int)
    tolerance = 0 if suffix != ".jpg" else 6
    assert np.abs(decoded - UPRIGHT[orientation](photo)).max() <= tolerance


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_size_is_read_without_decoding(suffix, write_image) -> None:
    assert read_header(write_image(f"a{suffix}").read_bytes()).size == (80, 60)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".ppm"])
def test_formats_without_loss(suffix, photo, write_image) -> None:
    assert np.array_equal(decode(write_image(f"a{suffix}")), photo)


def test_content_determines_the_format_instead_of_the_name(photo, write_image) -> None:
    path = write_image("a.png")
    assert np.array_equal(decode(path.rename(path.with_suffix(".JPG"))), photo)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bit(suffix, photo, write_image) -> None:
    deep = photo.astype(np.uint16) * 257
    assert np.array_equal(decode(write_image(f"a{suffix}", deep)), photo)


def test_float_tiff_is_converted_to_8_bit(photo, write_image) -> None:
    path = write_image("a.tif", (photo / 255).astype(np.float32))
    assert np.array_equal(decode(path), photo)


def test_grayscale_and_alpha(photo, write_image) -> None:
    gray = decode(write_image("gray.png", photo[..., 0]))
    assert np.array_equal(gray, np.repeat(photo[..., :1], 3, axis=2))
    path = write_image("alpha.png")
    bgra = np.dstack([photo[..., ::-1], np.full(photo.shape[:2], 7, np.uint8)])
    path.write_bytes(cv2.imencode(".png", bgra)[1].tobytes())
    assert np.array_equal(decode(path), photo)


def test_orientation_of_tiff_is_applied_once(tmp_path: Path, photo: UInt8) -> None:
    """The TIFF decoder applies the orientation tag itself, so the image must not be rotated
    again."""
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff(photo, orientation=6))
    assert np.array_equal(decode(path), UPRIGHT[6](photo))


def _tiff(image: UInt8, orientation: int) -> bytes:
    """Return an uncompressed RGB TIFF of one strip."""
    height, width, _ = image.shape
    shorts = {258: 8, 259: 1, 262: 2, 274: orientation, 277: 3}
    longs = {256: width, 257: height, 273: 0, 278: height, 279: image.nbytes}
    tags = sorted({**shorts, **longs})
    pixels = 8 + 2 + 12 * len(tags) + 4
    longs[273] = pixels + 6
    directory = b""
    for tag in tags:
        if tag == 258:  # one value a sample, stored before the pixels
            directory += struct.pack("<HHII", tag, 3, 3, pixels)
        elif tag in shorts:
            directory += struct.pack("<HHIHH", tag, 3, 1, shorts[tag], 0)
        else:
            directory += struct.pack("<HHII", tag, 4, 1, longs[tag])
    header = struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    return header + directory + bytes(4) + struct.pack("<3H", 8, 8, 8) + image.tobytes()


@pytest.mark.parametrize("content", [b"", b"hello", b"\xff\xd8\xff\xe0"])
def test_decode_of_other_file_raises(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.jpg"):
        decode(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_decode_of_truncated_image_raises(suffix, write_image) -> None:
    path = write_image(f"a{suffix}")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="cannot be decoded"):
        decode(path)


def test_read_bytes_of_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.jpg cannot be read"):
        read_bytes(tmp_path / "nowhere.jpg")


def test_decode_mask_is_true_at_nonzero_pixels(photo, write_image) -> None:
    drawn = np.zeros(photo.shape[:2], dtype=np.uint8)
    drawn[10:20, 30:50] = 255
    assert np.array_equal(decode_mask(write_image("m.png", drawn), 4800), drawn > 0)
