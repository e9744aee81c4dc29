"""Check image files and decode them to upright 8-bit RGB."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float64, UInt8
from mpsfm_core.data.cameras import MapOrientation
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
"""File extensions of images; the file content, not the extension, selects the decoder."""


_Value = TypeVar("_Value", bound=np.generic)


def read_bytes(path: Path) -> bytes:
    """Read the bytes of an image file; raise :class:`InputError` if reading fails."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror or error}") from error


def check_decodable(data: bytes, path: Path) -> UInt8 | None:
    """Decode an image at 1/8 size; raise :class:`InputError` if it is damaged or not an image.

    Returns:
        (h, w) uint8 gray image at 1/8 size, or None for formats that OpenCV does not decode.
    """
    if is_cut_jpeg(data):
        raise InputError(
            f"image {path} is cut off: the end of the file is missing. Copy the image file again"
        )
    if find_decoder(data, path) is not None:  # other formats are decoded in ``upright_size``
        return None
    return decode_stored(data, path, cv2.IMREAD_REDUCED_GRAYSCALE_8)


def check_size(data: bytes, path: Path, max_pixels: int) -> None:
    """Raise :class:`InputError` for an image with more than ``max_pixels`` pixels."""
    pixels = read_declared_num_pixels(data)
    if pixels is not None and pixels > max_pixels:
        raise InputError(
            f"image {path} has {pixels / 1e6:.0f} million pixels, more than inputs.max_pixels="
            f"{max_pixels}; reduce the image or raise the limit"
        )


def upright_size(data: bytes, header: ImageHeader, path: Path) -> tuple[int, int]:
    """Return (width, height) of an image after EXIF rotation.

    The pixels are decoded only if the image header has no size.

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

    16-bit values are divided by 257, floats in [0, 1] multiplied by 255, gray is repeated as RGB,
    and alpha is dropped.

    Returns:
        (H, W, 3) uint8 upright RGB image.

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


def orient(image: NDArray[_Value], orientation: int) -> NDArray[_Value]:
    """Rotate or flip a stored image upright by its EXIF ``orientation`` (1 if already upright)."""
    if orientation >= 5:
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def find_map_orientation(
    map_size: tuple[int, int], size: tuple[int, int], orientation: int, convention: MapOrientation
) -> int:
    """Return the EXIF orientation that rotates a depth, normal or mask map upright.

    Args:
        map_size: (width, height) of the map, which covers the image in any resolution.
        size: (width, height) of the upright image.
        orientation: EXIF orientation of the image.
        convention: ``stored`` for maps with the axes of the stored pixels, ``upright`` for maps
            with the axes of the upright image, or ``auto`` to choose by aspect ratio. A map that
            fits both aspect ratios has the axes of the stored pixels.

    Returns:
        ``orientation`` if the map has the axes of the stored pixels, or 1 if the map is upright.
    """
    if convention != "auto" or min(map_size) == 0:
        return 1 if convention == "upright" else orientation
    aspect, upright = (math.log(width / height) for width, height in (map_size, size))
    stored = -upright if orientation >= 5 else upright
    return 1 if abs(aspect - upright) < abs(aspect - stored) else orientation


def apply_orientation_to_pixels(xy: Float64, size: tuple[int, int], orientation: int) -> Float64:
    """Map pixels (n, 2) of a stored image of (width, height) to its upright image."""
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
    """Decode an image with OpenCV to BGR, BGRA or gray of any bit depth, without EXIF rotation."""
    if not data:
        raise InputError(f"image {path} is empty")
    try:
        # IMREAD_UNCHANGED: OpenCV's rotation and depth conversion differ between formats.
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"image {path} cannot be decoded: {error.err}") from error
    if pixels is None:
        raise InputError(
            f"image {path} cannot be decoded: the file is damaged or not an image. "
            f"Replace or remove the image file"
        )
    return np.asarray(pixels)
