"""Parse size, orientation and EXIF tags of image headers without decoding pixels."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

from mpsfm_core.geometry.focal_length import (
    DIAGONAL_35MM,
    compute_equivalent_mm,
    is_plausible_equivalent,
)
from mpsfm_core.inputs.codecs import avif_exif, heif_exif, is_avif, is_heif

_EXIF_SIGNATURE = b"Exif\x00\x00"
_XMP_SIGNATURE = b"http://ns.adobe.com/xap/1.0/\x00"
_JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset((0x01, *range(0xD0, 0xD9)))
_TYPE_FORMATS = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii"}
_TYPE_SIZES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
_MAX_ASPECT_DIFFERENCE = 0.02
"""Difference of log aspect ratios of image and EXIF above which the image counts as cropped."""

_TIFF_WIDTH, _TIFF_HEIGHT = 0x0100, 0x0101
_ORIENTATION, _EXIF_IFD = 0x0112, 0x8769
_CAMERA_TAGS = {0x010F: "make", 0x0110: "model", 0xA431: "serial number", 0xA434: "lens"}
_ASCII = 2
_FOCAL_MM, _FOCAL_35MM = 0x920A, 0xA405
_PIXELS_X, _PIXELS_Y = 0xA002, 0xA003
_PLANE_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file."""

    size: tuple[int, int] | None
    """(width, height) in pixels before EXIF rotation, None if the header has no size."""
    orientation: int
    """EXIF orientation of the stored pixels, 1 to 8."""
    tags: dict[int, float]
    """Values of the numeric EXIF tags by tag number."""
    projection: str | None = None
    """Projection of a panorama such as ``equirectangular``, None for other images."""
    camera: str = ""
    """Make, model, serial number and lens in EXIF, empty without make and model."""

    @property
    def recorded_size(self) -> tuple[float, float]:
        """Image size (width, height) recorded in EXIF, 0 if absent, often outdated by editors."""
        return self.tags.get(_PIXELS_X, 0.0), self.tags.get(_PIXELS_Y, 0.0)

    def focal_px(self, width: int, height: int) -> float | None:
        """Return the focal length in pixels from EXIF, for an image of a given size.

        The 35 mm equivalent focal length is preferred, relative to the image diagonal (CIPA
        DCG-001). Without a 35 mm equivalent, the focal length is multiplied by the focal-plane
        resolution. Focal lengths that no lens has are ignored.

        Returns:
            Focal length in pixels, None if EXIF has none or the image was cropped.
        """
        recorded = self.recorded_size
        if min(recorded) > 0:
            ratio = (max(recorded) / min(recorded)) / (max(width, height) / min(width, height))
            if abs(math.log(ratio)) > _MAX_ASPECT_DIFFERENCE:
                return None
        # cameras write 0, 1 or 65535 for an unknown 35 mm equivalent
        equivalent_mm = self.tags.get(_FOCAL_35MM, 0.0)
        if is_plausible_equivalent(equivalent_mm):
            return equivalent_mm / DIAGONAL_35MM * math.hypot(width, height)
        focal_mm = self.tags.get(_FOCAL_MM, 0.0)
        resolution = self.tags.get(_PLANE_RESOLUTION, 0.0)
        unit_mm = _MM_PER_UNIT.get(int(self.tags.get(_PLANE_UNIT, 2)), 0.0)
        if min(focal_mm, resolution, unit_mm) <= 0:
            return None
        reduction = max(width, height) / max(recorded) if max(recorded) > 0 else 1.0
        focal_px = focal_mm * resolution / unit_mm * reduction
        equivalent_mm = compute_equivalent_mm(focal_px, width, height)
        return focal_px if is_plausible_equivalent(equivalent_mm) else None


def read_declared_num_pixels(data: bytes) -> int | None:
    """Return the number of pixels of an encoded image from its header, None if unknown."""
    if data[:4] in (b"II*\x00", b"MM\x00*"):
        tags = _read_tags(data)
        size = tags.get(_TIFF_WIDTH), tags.get(_TIFF_HEIGHT)
        return None if None in size else int(size[0] or 0) * int(size[1] or 0)
    sizes = read_header(data).size or _bmp_size(data) or _webp_size(data) or _pnm_size(data)
    sizes = sizes or _jp2_size(data)
    return None if sizes is None else sizes[0] * sizes[1]


def is_plain_rgb(data: bytes) -> bool:
    """Return whether an image is an 8-bit RGB JPEG or PNG, which all programs decode alike.

    Programs differ in how they decode gray, CMYK, palette, alpha and 16-bit images.
    """
    if data[:2] == b"\xff\xd8":
        frames = (p for m, p in _jpeg_segments(data) if m in _JPEG_SOF and len(p) >= 6)
        return next(((p[0], p[5]) for p in frames), None) == (8, 3)
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 26:
        is_transparent = any(name == b"tRNS" for name, _ in _chunks(data, 8, ">"))
        return (data[24], data[25]) == (8, 2) and not is_transparent
    return False


def has_alpha(data: bytes) -> bool:
    """Return True if an encoded PNG or WebP image stores transparency in an alpha channel."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return len(data) > 25 and data[25] in (4, 6)
    return data[8:16] == b"WEBPVP8X" and len(data) > 20 and bool(data[20] & 0x10)


def is_cut_jpeg(data: bytes) -> bool:
    """Return whether a JPEG lacks its end marker; decoders fill missing pixels with gray."""
    if data[:2] != b"\xff\xd8":
        return False
    pixels = 2 + sum(4 + len(payload) for _, payload in _jpeg_segments(data))
    return data.rfind(b"\xff\xd9", pixels) < 0


def _bmp_size(data: bytes) -> tuple[int, int] | None:
    if data[:2] != b"BM" or len(data) < 26:
        return None
    width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) of the canvas or the first frame of a WebP file."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if data[12:16] == b"VP8X":
        return _three_bytes(data, 24) + 1, _three_bytes(data, 27) + 1
    if data[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _three_bytes(data: bytes, place: int) -> int:
    return int.from_bytes(data[place : place + 3], "little")


def _pnm_size(data: bytes) -> tuple[int, int] | None:
    gap = rb"(?:\s|#[^\n]*\n)+"
    match = re.match(rb"P[1-7]" + gap + rb"(\d{1,9})" + gap + rb"(\d{1,9})\s", data[:4096])
    return None if match is None else (int(match[1]), int(match[2]))


def _jp2_size(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) from the image header box or the SIZ marker of JPEG 2000."""
    box = data.find(b"ihdr", 0, 4096)
    if data[4:8] == b"jP  " and box > 0 and len(data) >= box + 12:
        height, width = struct.unpack_from(">II", data, box + 4)
        return width, height
    if data[:4] == b"\xff\x4f\xff\x51" and len(data) >= 16:
        return struct.unpack_from(">II", data, 8)
    return None


def read_header(data: bytes) -> ImageHeader:
    """Parse the header of an encoded image and skip its damaged or unknown parts."""
    size: tuple[int, int] | None = None
    if data[:2] == b"\xff\xd8":
        for marker, payload in _jpeg_segments(data):
            if marker in _JPEG_SOF and len(payload) >= 5:
                rows, columns = struct.unpack(">HH", payload[1:5])
                size = (columns, rows)
    elif data[:8] == b"\x89PNG\r\n\x1a\n":
        size = struct.unpack(">II", data[16:24]) if len(data) >= 24 else None
    block = exif_block(data)
    tags = _read_tags(block) if block else {}
    orientation = int(tags.get(_ORIENTATION, 1))
    if block is data or is_heif(data) or is_avif(data) or not 1 <= orientation <= 8:
        # Decoders apply the orientation of TIFF, HEIF and AVIF themselves.
        orientation = 1
    camera = _read_camera(block) if block else ""
    return ImageHeader(size, orientation, tags, _projection(data), camera)


def exif_block(data: bytes) -> bytes | None:
    """Return the TIFF structure that stores EXIF data in an image, None without EXIF."""
    if data[:2] == b"\xff\xd8":
        app1 = (p for m, p in _jpeg_segments(data) if m == 0xE1 and p.startswith(_EXIF_SIGNATURE))
        block = next(app1, None)
        return None if block is None else block[len(_EXIF_SIGNATURE) :]
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return next((c for name, c in _chunks(data, 8, ">") if name == b"eXIf"), None)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        block = next((c for name, c in _chunks(data, 12, "<") if name == b"EXIF"), None)
        return block.removeprefix(_EXIF_SIGNATURE) if block else None
    if data[:4] in (b"II*\x00", b"MM\x00*"):
        return data
    if is_avif(data):
        return avif_exif(data)
    return heif_exif(data) if is_heif(data) else None


def _projection(data: bytes) -> str | None:
    """Return the projection in the XMP data of a panorama, None for other images."""
    if data[:2] != b"\xff\xd8":
        return None
    for marker, payload in _jpeg_segments(data):
        if marker == 0xE1 and payload.startswith(_XMP_SIGNATURE):
            match = re.search(rb"GPano:ProjectionType\W{1,4}(\w{1,40})", payload)
            if match is not None:
                return match[1].decode("ascii", "replace")
    return None


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and payload of each JPEG segment before the pixel data."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xDA:
            return
        if marker == 0xFF or marker in _JPEG_WITHOUT_LENGTH:
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        yield marker, data[position + 4 : position + 2 + length]
        position += 2 + length


def _chunks(data: bytes, position: int, order: str) -> Iterator[tuple[bytes, bytes]]:
    """Yield the chunks of a PNG file or of a RIFF file such as WebP."""
    png = order == ">"
    while position + 8 <= len(data):
        first, second = data[position : position + 4], data[position + 4 : position + 8]
        name, raw_length = (second, first) if png else (first, second)
        (length,) = struct.unpack(order + "I", raw_length)
        yield name, data[position + 8 : position + 8 + length]
        position += 8 + length + (4 if png else length % 2)


def _read_tags(block: bytes) -> dict[int, float]:
    """Read the numeric tags of a TIFF structure, from its first and its EXIF directory."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None or len(block) < 8:
        return {}
    tags = _read_directory(block, order, struct.unpack_from(order + "I", block, 4)[0])
    if _EXIF_IFD in tags:
        tags |= _read_directory(block, order, int(tags[_EXIF_IFD]))
    return tags


def _read_camera(block: bytes) -> str:
    """Return make, model, serial number and lens of EXIF, empty without make and model."""
    offset = int(_read_tags(block).get(_EXIF_IFD, 0))
    texts = {}
    for directory in (None, offset) if offset else (None,):
        for tag, kind, number, place in tiff_entries(block, directory):
            if tag in _CAMERA_TAGS and kind == _ASCII:
                text = block[place : place + number].split(b"\0")[0].strip()
                texts[_CAMERA_TAGS[tag]] = text.decode("latin-1")
    if not (texts.get("make") or texts.get("model")):
        return ""
    return ", ".join(f"{name} {text}" for name, text in sorted(texts.items()) if text)


def tiff_entries(block: bytes, offset: int | None = None) -> Iterator[tuple[int, int, int, int]]:
    """Yield tag, type, value count and value offset of each entry of a TIFF directory.

    Args:
        block: TIFF structure. If the directory is cut off, only complete entries are yielded.
        offset: byte offset of the TIFF directory, by default of the first directory.
    """
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None or len(block) < 8:
        return
    with suppress(struct.error):
        if offset is None:
            (offset,) = struct.unpack_from(order + "I", block, 4)
        (count,) = struct.unpack_from(order + "H", block, offset)
        for entry in range(offset + 2, offset + 2 + 12 * count, 12):
            tag, kind, number = struct.unpack_from(order + "HHI", block, entry)
            place = entry + 8
            if number * _TYPE_SIZES.get(kind, 1) > 4:
                (place,) = struct.unpack_from(order + "I", block, place)
            yield tag, kind, number, place


def _read_directory(block: bytes, order: str, offset: int) -> dict[int, float]:
    tags = {}
    with suppress(struct.error):  # entries before the end of a cut-off TIFF directory are used
        for tag, kind, number, place in tiff_entries(block, offset):
            layout = _TYPE_FORMATS.get(kind)
            if layout is None or number != 1:
                continue
            values = struct.unpack_from(order + layout, block, place)
            tags[tag] = values[0] / values[1] if len(values) == 2 and values[1] else values[0]
    return tags
