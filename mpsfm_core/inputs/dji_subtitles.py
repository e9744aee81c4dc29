"""Read GPS positions from the subtitles (``.SRT``) that DJI drones write next to a video.

Each subtitle has a time range and the GPS position of the drone. Newer drone models write
``[latitude: 47.1] [longitude: 8.2] [rel_alt: 9.0 abs_alt: 410.0] [focal_len: 24.00]``, older models
write ``GPS(8.2,47.1,19)`` with the longitude first.
"""

from __future__ import annotations

import re
from pathlib import Path

from mpsfm_core.inputs.gps import GpsPosition
from mpsfm_core.inputs.text_files import read_text_file

_TIME = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{3})\s*-->")
_FIELD = re.compile(r"\b(latitude|long?t?itude|abs_alt|altitude|focal_len)\s*:\s*(-?\d+(?:\.\d+)?)")
_OLD_POSITION = re.compile(r"\bGPS\s*\(\s*(-?\d+\.\d+)\s*,\s*(-?\d+\.\d+)")
_TENTHS_MM = 200
"""Minimum subtitle value ``focal_len`` that is in tenths of a millimeter, as written by Mavic 2."""


def read_subtitles(path: Path) -> list[tuple[float, GpsPosition, float | None]]:
    """Read time in s, GPS position and 35 mm equivalent focal length in mm of each subtitle.

    Subtitles are skipped if they have no GPS position, or latitude and longitude 0, which drones
    write before the first GPS fix.

    Raises:
        OSError: the subtitle file cannot be read.
        ValueError: the subtitle file is not text.
    """
    points = []
    starts = list(_TIME.finditer(text := read_text_file(path)))
    for start, end in zip(starts, [*(m.start() for m in starts[1:]), len(text)], strict=True):
        hours, minutes, seconds, millis = map(int, start.groups())
        time_s = 3600 * hours + 60 * minutes + seconds + millis / 1000
        block = text[start.end() : end]
        fields = {name: float(value) for name, value in _FIELD.findall(block)}
        latitude = fields.get("latitude")
        longitude = fields.get("longitude", fields.get("longtitude"))
        if (old := _OLD_POSITION.search(block)) is not None:
            longitude, latitude = float(old[1]), float(old[2])
        if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
            continue
        if abs(latitude) > 90 or abs(longitude) > 180:
            continue
        altitude = fields.get("abs_alt", fields.get("altitude"))
        focal = fields.get("focal_len")
        if focal is not None and focal >= _TENTHS_MM:
            focal /= 10
        points.append((time_s, GpsPosition(latitude, longitude, altitude), focal))
    return points
