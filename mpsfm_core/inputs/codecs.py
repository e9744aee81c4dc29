"""Photos that need a library of their own: HEIC of phones, raw files of cameras."""

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
"""File names; a raw file's content tells no more than its name, most are TIFF files too."""


def find_decoder(data: bytes, path: Path) -> Callable[[bytes, Path], UInt8] | None:
    """What decodes this content of a file called so, None if OpenCV does.

    It gives (H, W, 3) uint8 RGB, upright, and raises :class:`InputError` when the file is damaged
    or the library is not installed.
    """
    if is_heif(data):
        return _decode_heif
    raw = path.suffix.lower() in RAW and data[:3] != b"\xff\xd8\xff"
    return _decode_raw if raw else None


def is_heif(data: bytes) -> bool:
    """Whether the content is HEIF; AVIF is not, which nobody's photos are."""
    return data[4:8] == b"ftyp" and data[8:12] in (b"heic", b"heix", b"hevc", b"mif1", b"msf1")


def heif_exif(data: bytes) -> bytes | None:
    """The EXIF block of an HEIF file; None if there is none, or nobody to read it."""
    try:
        opened = importlib.import_module("pillow_heif").open_heif(data)
        block = opened.info.get("exif")
    except Exception:  # what cannot be read says nothing; decoding it tells why
        return None
    return None if block is None else bytes(block).removeprefix(b"Exif\x00\x00")


def _decode_heif(data: bytes, path: Path) -> UInt8:
    library = _library("pillow_heif", "heic", path)
    try:
        image = library.read_heif(data)  # applies the rotation that the file asks for
        pixels = np.asarray(image.to_pillow().convert("RGB"))
    except Exception as error:  # the library raises what its parts raise
        raise InputError(f"image {path} cannot be decoded: {error}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def _decode_raw(data: bytes, path: Path) -> UInt8:
    library = _library("rawpy", "raw", path)
    try:
        with library.imread(BytesIO(data)) as raw:
            pixels = raw.postprocess(use_camera_wb=True, output_bps=8)
    except Exception as error:  # the library raises what its parts raise
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
