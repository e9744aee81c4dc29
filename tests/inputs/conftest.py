"""Fixtures that write image files with EXIF data byte by byte."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import UInt8

WriteImage = Callable[..., Path]

_SHORT, _LONG, _RATIONAL = 3, 4, 5
_KINDS = {0x0112: _SHORT, 0xA405: _SHORT, 0xA210: _SHORT, 0xA002: _LONG, 0xA003: _LONG}
_EXIF_IFD = 0x8769


def exif_block(tags: Mapping[int, float], order: str = "<") -> bytes:
    """Return a TIFF structure with the orientation in IFD0 and all other tags in the EXIF IFD."""
    first = {tag: value for tag, value in tags.items() if tag < _EXIF_IFD}
    second = {tag: value for tag, value in tags.items() if tag > _EXIF_IFD}
    exif_offset = 8 + 2 + 12 * (len(first) + 1) + 4
    header = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    main = _directory({**first, _EXIF_IFD: exif_offset}, order, 8)
    return header + main + _directory(second, order, exif_offset)


def _directory(tags: Mapping[int, float], order: str, offset: int) -> bytes:
    entries, values = b"", b""
    behind = offset + 2 + 12 * len(tags) + 4
    for tag, value in sorted(tags.items()):
        kind = _KINDS.get(tag, _LONG if tag == _EXIF_IFD else _RATIONAL)
        if kind == _RATIONAL:
            content = struct.pack(order + "I", behind + len(values))
            values += struct.pack(order + "II", round(value * 1000), 1000)
        else:
            content = struct.pack(order + ("HH" if kind == _SHORT else "I"), *_padded(value, kind))
        entries += struct.pack(order + "HHI", tag, kind, 1) + content
    return struct.pack(order + "H", len(tags)) + entries + struct.pack(order + "I", 0) + values


def _padded(value: float, kind: int) -> tuple[int, ...]:
    return (int(value), 0) if kind == _SHORT else (int(value),)


def with_exif(data: bytes, block: bytes) -> bytes:
    """Return an encoded JPEG, PNG or WebP image with an added EXIF block."""
    if data.startswith(b"\xff\xd8"):
        payload = b"Exif\x00\x00" + block
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]
    if data.startswith(b"\x89PNG"):
        chunk = b"eXIf" + block
        crc = struct.pack(">I", zlib.crc32(chunk))
        return data[:33] + struct.pack(">I", len(block)) + chunk + crc + data[33:]
    padded = block + b"\x00" * (len(block) % 2)
    body = data[12:] + b"EXIF" + struct.pack("<I", len(block)) + padded
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


@pytest.fixture
def photo() -> UInt8:
    """Return an RGB image (60, 80, 3) with different corners and channels, smooth enough for
    JPEG."""
    rows, columns = np.mgrid[0:60, 0:80]
    image = np.stack([columns * 3, rows * 4, (columns + rows) // 2 + 100], axis=-1)
    return image.astype(np.uint8)


@pytest.fixture
def write_image(tmp_path: Path, photo: UInt8) -> WriteImage:
    """Return ``write(name, image=photo, tags=None, order="<")``, which writes to the image
    folder."""

    def write(
        name: str,
        image: UInt8 = photo,
        tags: Mapping[int, float] | None = None,
        order: str = "<",
    ) -> Path:
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        bgr = image[..., ::-1] if image.ndim == 3 else image
        parameters = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
        parameters += [cv2.IMWRITE_WEBP_QUALITY, 101] if path.suffix == ".webp" else []
        data = cv2.imencode(path.suffix, np.ascontiguousarray(bgr), parameters)[1].tobytes()
        path.write_bytes(with_exif(data, exif_block(tags, order)) if tags else data)
        return path

    return write
