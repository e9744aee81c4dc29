"""Decoders of optional libraries: HEIF images of phones, raw files of cameras."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import UInt8
from mpsfm_core.data.errors import InputError

HEIF = frozenset((".heic", ".heif", ".hif"))
RAW = frozenset((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"))
"""Extensions of raw files. The content does not identify them: most are TIFF files."""


def find_decoder(data: bytes, path: Path) -> Callable[[bytes, Path], UInt8] | None:
    """Return the decoder of an image that OpenCV does not read, else None.

    Args:
        data: content of the file.
        path: its extension identifies raw files.

    Returns:
        A function of ``data`` and ``path`` that returns the upright image, (H, W, 3) uint8 RGB. It
        raises :class:`InputError` for a damaged file and for a missing library.
    """
    if is_heif(data):
        return _decode_heif
    raw = path.suffix.lower() in RAW and data[:3] != b"\xff\xd8\xff"
    return _decode_raw if raw else None


def is_heif(data: bytes) -> bool:
    """Return whether the content is HEIF (AVIF is not included)."""
    return data[4:8] == b"ftyp" and data[8:12] in (b"heic", b"heix", b"hevc", b"mif1", b"msf1")


def heif_exif(data: bytes) -> bytes | None:
    """Return the EXIF block of a HEIF file, None if there is none or ``pillow_heif`` is missing."""
    try:
        opened = importlib.import_module("pillow_heif").open_heif(data)
        block = opened.info.get("exif")
    except Exception:  # decoding the pixels reports the reason
        return None
    return None if block is None else bytes(block).removeprefix(b"Exif\x00\x00")


def _decode_heif(data: bytes, path: Path) -> UInt8:
    library = _library("pillow_heif", "heic", path)
    try:
        image = library.read_heif(data)  # applies the rotation in the file
        pixels = np.asarray(image.to_pillow().convert("RGB"))
    except Exception as error:  # the library documents no exception types
        raise InputError(f"image {path} cannot be decoded: {error}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def _decode_raw(data: bytes, path: Path) -> UInt8:
    library = _library("rawpy", "raw", path)
    try:
        with library.imread(BytesIO(data)) as raw:
            pixels = raw.postprocess(use_camera_wb=True, output_bps=8)
    except Exception as error:  # the library documents no exception types
        raise InputError(f"image {path} cannot be decoded: {error!r}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def _library(name: str, extra: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"image {path}: reading {path.suffix} files needs {name.replace('_', '-')}: "
            f"pip install 'mpsfm-core[{extra}]'"
        ) from error
