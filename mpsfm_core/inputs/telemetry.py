"""GPS positions that a drone or action camera recorded with a video, as EXIF of its frames."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.dji_subtitles import read_subtitles
from mpsfm_core.inputs.gopro import read_positions
from mpsfm_core.inputs.gps import GpsPosition, insert_exif

_log = logging.getLogger(__name__)

_MAX_GAP_S = 1.0
"""Maximum time in seconds between a video frame and the nearest GPS measurement."""
_GOPRO_EXTENSIONS = frozenset((".mp4", ".mov"))


@dataclass(frozen=True)
class Telemetry:
    """GPS positions of a video by time, and the focal length of the video if recorded."""

    points: tuple[tuple[float, GpsPosition], ...]
    """Times in seconds from the start of the video, ascending, each with its GPS position."""
    focal_35mm_mm: float | None
    """35 mm equivalent focal length in mm, None if unknown or zoomed during the video."""
    fps: float
    """Frames per second of the video."""

    @property
    def digest(self) -> str:
        """Return a hash of the GPS positions and the focal length of a video."""
        return hashlib.sha256(repr((self.points, self.focal_35mm_mm)).encode()).hexdigest()

    def position(self, time_s: float) -> GpsPosition | None:
        """Interpolate the GPS position at a time, None without a measurement within one second."""
        times = np.array([time for time, _ in self.points])
        if not len(times) or np.abs(times - time_s).min() > _MAX_GAP_S:
            return None
        rows = [(p.latitude, p.longitude, p.altitude) for _, p in self.points]
        values = np.array(rows, dtype=np.float64)  # None becomes NaN
        latitude, longitude, altitude = (float(np.interp(time_s, times, v)) for v in values.T)
        return GpsPosition(latitude, longitude, None if np.isnan(altitude) else altitude)

    def add_exif(self, jpeg: bytes, number: int) -> bytes:
        """Insert GPS position and focal length as EXIF data into the JPEG file of a video frame."""
        return insert_exif(jpeg, self.position(number / self.fps), self.focal_35mm_mm)


def read_telemetry(video: Path) -> Telemetry:
    """Read GPS positions of a video from DJI's subtitles, or from the telemetry track of GoPro.

    If the subtitles or the telemetry track are damaged, a warning is logged and no position is
    returned.
    """
    points: list[tuple[float, GpsPosition]] = []
    focals: set[float | None] = set()
    subtitles = next((p for s in (".srt", ".SRT") if (p := video.with_suffix(s)).is_file()), None)
    try:
        if subtitles is not None:
            for time_s, position, focal in read_subtitles(subtitles):
                points.append((time_s, position))
                focals.add(focal)
        elif video.suffix.lower() in _GOPRO_EXTENSIONS:
            points = read_positions(video)
    except (OSError, ValueError, InputError) as error:
        _log.warning("the GPS positions of video %s are not used: %s", video, error)
    focal = focals.pop() if len(focals) == 1 else None
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG) if points else None
    fps = capture.get(cv2.CAP_PROP_FPS) if capture is not None else 0.0
    if capture is not None:
        capture.release()
    if not fps > 0:
        return Telemetry((), focal, 1.0)
    return Telemetry(tuple(sorted(points, key=lambda point: point[0])), focal, fps)
