"""Pixels of an image file: upright, RGB, 8 bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float64, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.codecs import HEIF, RAW, find_decoder
from mpsfm_core.inputs.image_header import (
    ImageHeader,
    is_cut_jpeg,
    read_declared_num_pixels,
    read_header,
)

EXTENSIONS = (
    HEIF
    | RAW
    | frozenset(
        (".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".webp", ".bmp", ".jp2", ".ppm", ".pgm")
    )
)
"""File names that count as images; the content may be any of these formats."""


def read_bytes(path: Path) -> bytes:
    """The file's content; raises :class:`InputError` when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror or error}") from error


def check_decodable(data: bytes, path: Path) -> None:
    """Decode an image once, coarsely; raises :class:`InputError` when it is damaged or none."""
    if is_cut_jpeg(data):
        raise InputError(f"image {path} is cut off: its end is missing; copy it again")
    if find_decoder(data, path) is None:  # others are decoded whole, for their size
        _decode(data, path, cv2.IMREAD_REDUCED_GRAYSCALE_8)


def check_size(data: bytes, path: Path, max_pixels: int) -> None:
    """Raise :class:`InputError` for an image that would take too much memory to decode."""
    pixels = read_declared_num_pixels(data)
    if pixels is not None and pixels > max_pixels:
        raise InputError(
            f"image {path} has {pixels / 1e6:.0f} million pixels, more than inputs.max_pixels="
            f"{max_pixels}; reduce the image or raise the limit"
        )


def upright_size(data: bytes, header: ImageHeader, path: Path) -> tuple[int, int]:
    """(width, height) with the EXIF orientation applied; decodes only where the header lacks it.

    Raises :class:`InputError` when the file is no image or damaged.
    """
    size = header.size
    if size is None or min(size) == 0:
        pixels = decode_rgb(data, header, path)
        return pixels.shape[1], pixels.shape[0]
    return (size[1], size[0]) if header.orientation >= 5 else size


def decode_rgb(data: bytes, header: ImageHeader, path: Path) -> UInt8:
    """(H, W, 3) uint8 RGB with the EXIF orientation applied.

    16-bit values are scaled by 1/257, floats in [0, 1] by 255; grayscale is repeated, alpha
    dropped. Raises :class:`InputError` when the file is no image or damaged.
    """
    decode = find_decoder(data, path)
    if decode is not None:
        return decode(data, path)
    pixels = _decode(data, path)
    if pixels.ndim == 2:
        rgb = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    elif pixels.shape[2] == 2:
        rgb = cv2.cvtColor(np.ascontiguousarray(pixels[..., 0]), cv2.COLOR_GRAY2RGB)
    else:
        rgb = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_BGR2RGB)
    if rgb.dtype == np.uint16:
        rgb = np.round(rgb / np.float32(257.0))
    elif rgb.dtype != np.uint8:
        rgb = np.round(np.clip(np.nan_to_num(rgb), 0, 1) * 255.0)
    return orient(rgb.astype(np.uint8), header.orientation)


def read_mask(path: Path, max_pixels: int) -> Bool:
    """(H, W) bool from a mask image, upright: False where it is black."""
    data = read_bytes(path)
    check_size(data, path, max_pixels)
    rgb = decode_rgb(data, read_header(data), path)
    return np.asarray(rgb.any(axis=2))


def orient(image: UInt8, orientation: int) -> UInt8:
    """The stored image turned upright; ``orientation`` is EXIF's (1: already upright)."""
    if orientation >= 5:
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def apply_orientation_to_pixels(xy: Float64, size: tuple[int, int], orientation: int) -> Float64:
    """Pixels (n, 2) of a stored image of (width, height) as those of :func:`orient`'s."""
    x, y = xy[:, 0], xy[:, 1]
    width, height = size
    if orientation >= 5:
        x, y, width, height = y, x, height, width
    if orientation in (3, 4, 7, 8):
        y = height - y
    if orientation in (2, 3, 6, 7):
        x = width - x
    return np.stack([x, y], axis=1)


def _decode(data: bytes, path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    if not data:
        raise InputError(f"image {path} is empty")
    try:
        # Unchanged: OpenCV's own rotation and depth conversion differ between formats.
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"image {path} cannot be decoded: {error.err}") from error
    if pixels is None:
        raise InputError(
            f"image {path} cannot be decoded: it is damaged or no image; replace or remove it"
        )
    return np.asarray(pixels)
