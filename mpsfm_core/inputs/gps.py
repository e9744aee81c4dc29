"""Read GPS positions from EXIF data and convert them to east, north, up."""

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
