"""Decode HEIF and AVIF images and raw camera files with optional libraries."""

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
AVIF = frozenset((".avif",))
RAW = frozenset(
    (
        *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"),
        *(".srw", ".nrw", ".rwl", ".3fr", ".iiq", ".mrw", ".erf", ".kdc", ".mef", ".x3f"),
    )
)
"""File extensions of raw camera images, whose content looks like TIFF."""


def find_decoder(data: bytes, path: Path) -> Callable[[bytes, Path], UInt8] | None:
    """Return a decoder for an image format that OpenCV cannot read, else None.

    Args:
        data: bytes of the image file.
        path: path of the image file, whose extension identifies raw camera images.

    Returns:
        A function of ``data`` and ``path`` that returns the upright image, (H, W, 3) uint8 RGB. The
        decoder raises :class:`InputError` for a damaged image or a missing library.
    """
    if is_heif(data):
        return _decode_heif
    if is_avif(data):
        return _decode_avif
    raw = path.suffix.lower() in RAW and data[:3] != b"\xff\xd8\xff"
    return _decode_raw if raw else None


def is_heif(data: bytes) -> bool:
    """Return whether the bytes of an image are HEIF, but not AVIF."""
    return data[4:8] == b"ftyp" and data[8:12] in (b"heic", b"heix", b"hevc", b"mif1", b"msf1")


def is_avif(data: bytes) -> bool:
    """Return whether the bytes of an image are AVIF."""
    return data[4:12] in (b"ftypavif", b"ftypavis")


def avif_exif(data: bytes) -> bytes | None:
    """Return the EXIF block of an AVIF file, None without EXIF data or without Pillow."""
    try:
        with importlib.import_module("PIL.Image").open(BytesIO(data)) as image:
            block = image.info.get("exif")
    except Exception:  # the decoder reports a damaged file later
        return None
    return bytes(block).removeprefix(b"Exif\x00\x00") if block else None


def heif_exif(data: bytes) -> bytes | None:
    """Return the EXIF block of a HEIF file, None without EXIF data or ``pillow_heif``."""
    try:
        opened = importlib.import_module("pillow_heif").open_heif(data)
        block = opened.info.get("exif")
    except Exception:  # the decoder reports a damaged file later
        return None
    return None if block is None else bytes(block).removeprefix(b"Exif\x00\x00")


def _decode_heif(data: bytes, path: Path) -> UInt8:
    library = _library("pillow_heif", "heic", path)
    try:
        image = library.read_heif(data)  # pillow_heif applies the EXIF rotation
        pixels = np.asarray(image.to_pillow().convert("RGB"))
    except Exception as error:  # pillow_heif does not document exceptions
        raise InputError(f"image file {path} cannot be decoded: {error}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def _decode_avif(data: bytes, path: Path) -> UInt8:
    pillow = _library("PIL.Image", "avif", path)
    operations = importlib.import_module("PIL.ImageOps")
    try:
        with pillow.open(BytesIO(data)) as image:
            pixels = np.asarray(operations.exif_transpose(image).convert("RGB"))
    except pillow.UnidentifiedImageError as error:
        raise InputError(
            f"image {path}: the installed Pillow does not read AVIF: pip install 'mpsfm-core[avif]'"
        ) from error
    except Exception as error:  # Pillow does not document all exceptions
        raise InputError(f"image file {path} cannot be decoded: {error}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def _decode_raw(data: bytes, path: Path) -> UInt8:
    library = _library("rawpy", "raw", path)
    try:
        with library.imread(BytesIO(data)) as raw:
            pixels = raw.postprocess(use_camera_wb=True, output_bps=8)
    except Exception as error:  # rawpy does not document exceptions
        raise InputError(f"image {path} cannot be decoded: {error!r}") from error
    return np.ascontiguousarray(pixels, dtype=np.uint8)


_PACKAGES = {"pillow_heif": "pillow-heif", "rawpy": "rawpy", "PIL.Image": "Pillow 11.3 or newer"}


def _library(name: str, extra: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"image {path}: reading {path.suffix} files needs {_PACKAGES[name]}: "
            f"pip install 'mpsfm-core[{extra}]'"
        ) from error
