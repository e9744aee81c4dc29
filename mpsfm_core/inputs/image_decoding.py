"""Decoding of image files to upright 8-bit RGB, and checks before it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float64, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.codecs import AVIF, HEIF, RAW, find_decoder
from mpsfm_core.inputs.image_header import (
    ImageHeader,
    is_cut_jpeg,
    read_declared_num_pixels,
)

EXTENSIONS = (
    HEIF
    | AVIF
    | RAW
    | frozenset(
        (
            *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".tif", ".tiff", ".webp", ".bmp"),
            *(".jp2", ".ppm", ".pgm"),
        )
    )
)
"""Extensions of image files. The content decides the decoder, not the extension."""


def read_bytes(path: Path) -> bytes:
    """Read the content of an image file; raise :class:`InputError` if this fails."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror or error}") from error


def check_decodable(data: bytes, path: Path) -> None:
    """Decode an image at 1/8 size; raise :class:`InputError` if it is damaged or not an image."""
    if is_cut_jpeg(data):
        raise InputError(f"image {path} is cut off: its end is missing. Copy it again")
    if find_decoder(data, path) is None:  # other formats are decoded in full to get their size
        decode_stored(data, path, cv2.IMREAD_REDUCED_GRAYSCALE_8)


def check_size(data: bytes, path: Path, max_pixels: int) -> None:
    """Raise :class:`InputError` for an image with more than ``max_pixels`` pixels."""
    pixels = read_declared_num_pixels(data)
    if pixels is not None and pixels > max_pixels:
        raise InputError(
            f"image {path} has {pixels / 1e6:.0f} million pixels, more than inputs.max_pixels="
            f"{max_pixels}; reduce the image or raise the limit"
        )


def upright_size(data: bytes, header: ImageHeader, path: Path) -> tuple[int, int]:
    """Return (width, height) with the EXIF orientation applied.

    Decodes the pixels only if the header has no size.

    Raises:
        InputError: the file is damaged or not an image.
    """
    size = header.size
    if size is None or min(size) == 0:
        pixels = decode_rgb(data, header, path)
        return pixels.shape[1], pixels.shape[0]
    return (size[1], size[0]) if header.orientation >= 5 else size


def decode_rgb(data: bytes, header: ImageHeader, path: Path) -> UInt8:
    """Decode an image and apply its EXIF orientation.

    Scales 16-bit values by 1/257 and floats in [0, 1] by 255, repeats gray, drops alpha.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InputError: the file is damaged or not an image.
    """
    decode = find_decoder(data, path)
    if decode is not None:
        return decode(data, path)
    pixels = decode_stored(data, path)
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


def orient(image: UInt8, orientation: int) -> UInt8:
    """Turn a stored image upright; ``orientation`` is the EXIF value, 1 for upright."""
    if orientation >= 5:
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def apply_orientation_to_pixels(xy: Float64, size: tuple[int, int], orientation: int) -> Float64:
    """Map pixels (n, 2) of a stored image of (width, height) to the image of :func:`orient`."""
    x, y = xy[:, 0], xy[:, 1]
    width, height = size
    if orientation >= 5:
        x, y, width, height = y, x, height, width
    if orientation in (3, 4, 7, 8):
        y = height - y
    if orientation in (2, 3, 6, 7):
        x = width - x
    return np.stack([x, y], axis=1)


def decode_stored(data: bytes, path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """Decode the stored pixels with OpenCV: BGR or BGRA or gray, any depth, not oriented."""
    if not data:
        raise InputError(f"image {path} is empty")
    try:
        # IMREAD_UNCHANGED: OpenCV's rotation and depth conversion differ between formats.
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"image {path} cannot be decoded: {error.err}") from error
    if pixels is None:
        raise InputError(
            f"image {path} cannot be decoded: it is damaged or not an image. Replace or remove it"
        )
    return np.asarray(pixels)
