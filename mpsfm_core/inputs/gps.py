"""Read and write GPS positions in EXIF data, and convert them to east, north, up."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.inputs.image_header import exif_block, tiff_entries

_GPS_IFD = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE = 1, 2, 3, 4
_ALTITUDE_REF, _ALTITUDE, _ERROR_M = 5, 6, 31
_EXIF_IFD, _FOCAL_35MM = 0x8769, 0xA405
_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL = 1, 2, 3, 4, 5
_ENTRY_BYTES = 12
DEFAULT_STD_M = 5.0
"""Default horizontal standard deviation of GPS in meters, for a phone [GPS.gov, 4.9 m]."""


@dataclass(frozen=True)
class GpsPosition:
    """GPS position in WGS84."""

    latitude: float
    """Latitude in degrees, [-90, 90]."""
    longitude: float
    """Longitude in degrees, [-180, 180]."""
    altitude: float | None = None
    """Altitude in meters, None if unknown."""
    std_m: float = DEFAULT_STD_M
    """Horizontal standard deviation of the position in meters."""


def read_gps(data: bytes) -> GpsPosition | None:
    """Read the GPS position from the EXIF data of an encoded image.

    Returns:
        The GPS position, or None if EXIF has no position or an invalid one such as (0, 0).
    """
    block = exif_block(data)
    if block is None:
        return None
    try:
        values = _values(block)
        latitude = _degrees(values, _LATITUDE, _LATITUDE_REF, b"S")
        longitude = _degrees(values, _LONGITUDE, _LONGITUDE_REF, b"W")
        altitude = _number(values, _ALTITUDE)
        if altitude is not None and values.get(_ALTITUDE_REF) in (b"\x01", [1]):
            altitude = -altitude
        std_m = _number(values, _ERROR_M) or DEFAULT_STD_M
    except (struct.error, ValueError, TypeError, ZeroDivisionError):
        return None
    plausible = abs(latitude) <= 90 and abs(longitude) <= 180 and 0 < std_m < math.inf
    if not plausible or (latitude == 0 and longitude == 0):
        return None
    if altitude is not None and not -1000 < altitude < 100_000:
        altitude = None
    return GpsPosition(latitude, longitude, altitude, std_m)


def insert_exif(
    jpeg: bytes, position: GpsPosition | None, focal_35mm_mm: float | None = None
) -> bytes:
    """Insert GPS position and focal length as EXIF data into a JPEG file without EXIF.

    Args:
        jpeg: bytes of a JPEG file without EXIF data.
        position: GPS position, or None to insert none.
        focal_35mm_mm: 35 mm equivalent focal length in mm, or None to insert none.
    """
    if position is None and focal_35mm_mm is None:
        return jpeg
    block = struct.pack("<2sHI", b"II", 42, 8)
    num_entries = (position is not None) + (focal_35mm_mm is not None)
    start = len(block) + 2 + _ENTRY_BYTES * num_entries + 4
    main, directories = [], b""
    if focal_35mm_mm is not None:
        main.append((_EXIF_IFD, _LONG, 1, struct.pack("<I", start)))
        focal = struct.pack("<H", round(focal_35mm_mm))
        directories = _directory([(_FOCAL_35MM, _SHORT, 1, focal)], start)
    if position is not None:
        main.append((_GPS_IFD, _LONG, 1, struct.pack("<I", start + len(directories))))
        directories += _directory(_gps_entries(position), start + len(directories))
    content = b"Exif\x00\x00" + block + _directory(main, len(block)) + directories
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content + jpeg[2:]


def _gps_entries(position: GpsPosition) -> list[tuple[int, int, int, bytes]]:
    """Return the EXIF entries of a GPS position, each with tag, type, count and value."""

    def degrees(angle: float) -> bytes:
        return struct.pack("<6I", round(abs(angle) * 1e7), 10_000_000, 0, 1, 0, 1)

    entries = [
        (_LATITUDE_REF, _ASCII, 2, b"S" if position.latitude < 0 else b"N"),
        (_LATITUDE, _RATIONAL, 3, degrees(position.latitude)),
        (_LONGITUDE_REF, _ASCII, 2, b"W" if position.longitude < 0 else b"E"),
        (_LONGITUDE, _RATIONAL, 3, degrees(position.longitude)),
    ]
    if position.altitude is not None:
        millimeters = struct.pack("<2I", round(abs(position.altitude) * 1000), 1000)
        entries.append((_ALTITUDE_REF, _BYTE, 1, b"\x01" if position.altitude < 0 else b"\x00"))
        entries.append((_ALTITUDE, _RATIONAL, 1, millimeters))
    return entries


def _directory(entries: list[tuple[int, int, int, bytes]], offset: int) -> bytes:
    """Encode a TIFF directory of EXIF entries that starts at a byte offset of the EXIF block."""
    values_start = offset + 2 + _ENTRY_BYTES * len(entries) + 4
    directory, values = struct.pack("<H", len(entries)), b""
    for tag, kind, count, value in entries:
        if len(value) > 4:
            place = struct.pack("<I", values_start + len(values))
            values += value
        else:
            place = value.ljust(4, b"\x00")
        directory += struct.pack("<HHI", tag, kind, count) + place
    return directory + struct.pack("<I", 0) + values


def convert_to_enu(positions: Sequence[GpsPosition], origin: GpsPosition) -> Float64:
    """Convert GPS positions to meters east, north and up of an origin.

    Returns:
        (n, 3) float64 east-north-up coordinates in meters; up is NaN without altitude.
    """
    reference = origin.altitude or 0.0
    geographic = [
        (p.latitude, p.longitude, reference if p.altitude is None else p.altitude)
        for p in positions
    ]
    enu: Float64 = np.asarray(
        pycolmap.GPSTransform().ellipsoid_to_enu(
            np.array(geographic), origin.latitude, origin.longitude, reference
        )
    )
    enu[[p.altitude is None for p in positions], 2] = np.nan
    return enu


def _values(block: bytes) -> dict[int, object]:
    """Read the entries of the EXIF GPS directory, texts as bytes and numbers as lists."""
    for tag, kind, count, place in tiff_entries(block):
        if tag == _GPS_IFD and kind in (4, 13) and count == 1:
            order = "<" if block[:2] == b"II" else ">"
            (offset,) = struct.unpack_from(order + "I", block, place)
            break
    else:
        raise ValueError("no GPS directory")
    values: dict[int, object] = {}
    for tag, kind, count, place in tiff_entries(block, offset):
        if kind in (1, 2) and count <= 4:
            values[tag] = block[place : place + count]
        elif kind == 5 and count <= 3:
            pairs = struct.unpack_from(f"{order}{2 * count}I", block, place)
            values[tag] = [
                pairs[i] / pairs[i + 1] if pairs[i + 1] else math.nan
                for i in range(0, 2 * count, 2)
            ]
    return values


def _degrees(values: dict[int, object], tag: int, reference: int, negative: bytes) -> float:
    parts = values.get(tag)
    if not isinstance(parts, list) or len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise ValueError("not an angle")
    angle: float = parts[0] + parts[1] / 60 + parts[2] / 3600
    sign = values.get(reference)
    return -angle if isinstance(sign, bytes) and sign[:1].upper() == negative else angle


def _number(values: dict[int, object], tag: int) -> float | None:
    parts = values.get(tag)
    if not isinstance(parts, list) or len(parts) != 1 or not math.isfinite(parts[0]):
        return None
    return float(parts[0])
