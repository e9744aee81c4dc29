"""Select sharp frames of a video, as far apart as matching allows."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mpsfm_core.data import Float32, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.inputs.telemetry import read_telemetry
from mpsfm_core.providers.weights import file_sha256
from mpsfm_core.support.files import replace_entries
from mpsfm_core.support.format_versions import VERSION, check_version

EXTENSIONS = frozenset((".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp", ".wmv"))
"""File extensions of videos."""
FRAMES = "frames"
"""Subfolder of the output folder with the selected video frames."""

Progress = Callable[[int, int], None]
"""Progress callback with the number of decoded frames and the number in the video header."""

_log = logging.getLogger(__name__)

_LIST = "frames.json"
FORMAT = 1
"""Format version of ``frames.json``, the origin of the selected frames."""
_TRACKED_SIDE = 480
"""Longer side in pixels of the downscaled frames in which points are tracked."""
_MAX_POINTS = 300
"""Maximum number of points tracked by Lucas-Kanade optical flow."""
_SHARPNESS_SIDE = 960
"""Longer side in pixels of the downscaled frames whose sharpness is measured."""
_MAX_BACKWARD_ERROR_PX = 1.0
"""Maximum forward-backward error in pixels of a tracked point."""
_EARLY_RATIO = 0.5
"""Share of the required motion from which a sharper frame may be selected earlier."""
_MIN_POINTS = 20
"""Minimum number of tracked points to measure the motion of a frame."""
_MAX_CANDIDATES = 300
"""Maximum number of candidate frames in memory, ten seconds of most videos."""
_MIN_FRAME_RATIO = 0.9
"""Minimum ratio of decoded frames to the frame count in the header of an undamaged video."""
_JPEG_QUALITY = 95
"""JPEG quality of the selected frames, from 0 to 100."""


def is_video(path: Path) -> bool:
    """Return whether a path has a video extension and is not a folder."""
    return path.suffix.lower() in EXTENSIONS and not path.is_dir()


def extract_frames(
    video: Path, output: Path, options: VideoOptions, progress: Progress | None = None
) -> Path:
    """Select frames of a video and write them as JPEG files into ``output/frames``.

    The name of a JPEG file contains the frame number. EXIF of the JPEG file has the GPS position if
    a drone or action camera recorded positions (see :func:`read_telemetry`). Existing frames of the
    same video and options are reused.

    Args:
        video: video file.
        output: output folder.
        options: options of the frame selection.
        progress: callback during decoding of the video.

    Returns:
        Path of the folder with the JPEG files.

    Raises:
        InputError: the file is not a video or is damaged, or the camera does not move.
    """
    folder = output / FRAMES
    origin: dict[str, Any] = {"sha256": _digest(video), "options": options.model_dump(mode="json")}
    telemetry = read_telemetry(video)
    if telemetry.points:
        origin["telemetry"] = telemetry.digest
    if _read_list(folder / _LIST) == origin:
        return folder
    origin[VERSION] = FORMAT
    chosen = choose_frames(video, options, progress)
    with replace_entries(output, (FRAMES,)) as fresh:
        (fresh / FRAMES).mkdir()
        for number, frame in read_frames(video, frozenset(chosen)):
            path = fresh / FRAMES / f"frame_{number:06d}.jpg"
            path.write_bytes(telemetry.add_exif(encode_frame(frame), number))
        (fresh / FRAMES / _LIST).write_text(json.dumps(origin), encoding="utf-8")
    return folder


def encode_frame(frame: UInt8) -> bytes:
    """Encode a BGR image as JPEG."""
    return cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def choose_frames(
    video: Path, options: VideoOptions, progress: Progress | None = None
) -> list[int]:
    """Select frames of a video; return their frame numbers in order.

    Points are tracked from each selected frame with Lucas-Kanade optical flow. The next frame is
    selected when the tracked points have moved by ``options.motion`` or only the share
    ``options.overlap`` of the points is still tracked. If an earlier frame nearby is sharper, the
    earlier frame is selected instead.

    Raises:
        InputError: as :func:`extract_frames`.
    """
    announced = _read_frame_count(video)
    chooser = _Chooser(options)
    decoded = 0
    for number, frame in read_frames(video):
        decoded = number + 1
        chooser.process(_Frame(number, _gray(frame, _TRACKED_SIDE), _sharpness(frame)))
        if progress is not None:
            progress(decoded, max(announced, decoded))
    if decoded < _MIN_FRAME_RATIO * announced:
        _log.warning("video %s is cut off: the file has %d of %d frames", video, decoded, announced)
    chosen = chooser.finish()
    if len(chosen) < 2:
        raise InputError(
            f"{video}: the camera hardly moves in its {decoded} frames. A reconstruction needs "
            f"images from several places; move the camera while filming"
        )
    if len(chosen) > options.max_frames:
        text = "%s: %d frames were chosen, %d evenly spaced ones are used (inputs.video.max_frames)"
        _log.warning(text, video, len(chosen), options.max_frames)
        rows = np.linspace(0, len(chosen) - 1, options.max_frames).round().astype(int)
        chosen = [chosen[row] for row in rows]
    return chosen


@dataclass(frozen=True, eq=False)
class _Frame:
    number: int
    gray: UInt8
    sharpness: float


@dataclass
class _Chooser:
    """Selector of frames by the motion of points tracked from the last selected frame."""

    options: VideoOptions
    chosen: list[int] = field(default_factory=list)
    _track: _Track | None = None
    _candidates: list[tuple[float, _Frame]] = field(default_factory=list)

    def process(self, frame: _Frame) -> None:
        """Track points into the next frame of the video and select frames."""
        if self._track is None:
            self._take(frame)
            return
        way = self._track.follow(frame.gray, self.options)
        if way < _EARLY_RATIO:
            self._candidates.clear()  # the camera is back at the last selected frame
            if (
                len(self.chosen) == 1
                and frame.sharpness > self._track.sharpness
                and way < _EARLY_RATIO / 2
            ):
                self.chosen.clear()  # replace the first frame by a sharper frame
                self._take(frame)
            return
        self._candidates.append((way, frame))
        if way >= 1 or len(self._candidates) >= _MAX_CANDIDATES:
            self._take_sharpest()

    def finish(self) -> list[int]:
        """Select from the remaining candidate frames; return the numbers of all selected frames."""
        while self._candidates:
            self._take_sharpest()
        return self.chosen

    def _take_sharpest(self) -> None:
        best = max(range(len(self._candidates)), key=lambda i: self._candidates[i][1].sharpness)
        later = [frame for _, frame in self._candidates[best + 1 :]]
        frame = self._candidates[best][1]
        self._candidates = []
        self._take(frame)
        for following in later:
            self.process(following)

    def _take(self, frame: _Frame) -> None:
        self.chosen.append(frame.number)
        self._track = _Track(frame)


class _Track:
    """Points of a selected frame, tracked through the following frames (Lucas-Kanade)."""

    def __init__(self, frame: _Frame) -> None:
        self.sharpness = frame.sharpness
        corners = cv2.goodFeaturesToTrack(frame.gray, _MAX_POINTS, 0.01, 5)
        none = np.zeros((0, 1, 2), np.float32)
        self._start: Float32 = none if corners is None else np.asarray(corners, np.float32)
        self._now = self._start
        self._count = len(self._start)
        self._last = frame.gray

    def follow(self, gray: UInt8, options: VideoOptions) -> float:
        """Track points into a frame; return the ratio of their motion to the required motion."""
        height, width = gray.shape
        if len(self._now) >= _MIN_POINTS:
            there, ok, _ = cv2.calcOpticalFlowPyrLK(self._last, gray, self._now, None)
            back, ok_back, _ = cv2.calcOpticalFlowPyrLK(gray, self._last, there, None)
            tracked = (ok.ravel() > 0) & (ok_back.ravel() > 0)
            tracked &= np.linalg.norm(back - self._now, axis=2).ravel() < _MAX_BACKWARD_ERROR_PX
            x, y = there[:, 0, 0], there[:, 0, 1]
            tracked &= (x >= 0) & (y >= 0) & (x < width) & (y < height)
            self._start, self._now = self._start[tracked], there[tracked]
        self._last = gray
        if len(self._now) < _MIN_POINTS:
            # If a blank wall or a cut hides the motion, the frame is selected.
            return 1.0
        moved = np.median(np.linalg.norm(self._now - self._start, axis=2))
        lost = 1 - len(self._now) / self._count
        return float(
            max(moved / (options.motion * np.hypot(width, height)), lost / (1 - options.overlap))
        )


def _gray(frame: UInt8, side: int) -> UInt8:
    factor = min(1.0, side / max(frame.shape[:2]))
    size = round(frame.shape[1] * factor), round(frame.shape[0] * factor)
    small = frame if factor == 1 else cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))


def _sharpness(frame: UInt8) -> float:
    """Measure sharpness by the variance of the Laplacian (Pech-Pacheco et al. 2000)."""
    return float(cv2.Laplacian(_gray(frame, _SHARPNESS_SIDE), cv2.CV_32F).var())


def read_frames(video: Path, wanted: frozenset[int] | None = None) -> Iterator[tuple[int, UInt8]]:
    """Yield number and upright BGR image of all frames, or of the frames ``wanted``."""
    with _opened(video) as capture:
        number = 0
        while capture.grab() and (wanted is None or number <= max(wanted)):
            if wanted is None or number in wanted:
                ok, frame = capture.retrieve()
                if ok and frame is not None and frame.size:
                    yield number, frame
            number += 1


def _read_frame_count(video: Path) -> int:
    with _opened(video) as capture:
        return max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # an InputError replaces FFmpeg's output
    try:
        capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    except cv2.error as error:
        raise InputError(f"video {video} cannot be opened: {error.err}") from error
    try:
        if not capture.isOpened():
            raise InputError(f"video {video} cannot be decoded: the file is damaged or not a video")
        yield capture
    finally:
        capture.release()


def _digest(video: Path) -> str:
    try:
        return file_sha256(video)
    except OSError as error:
        raise InputError(f"video {video} cannot be read: {error.strerror or error}") from error


def _read_list(path: Path) -> object:
    """Read the source video and options of the frames in ``frames.json``, None if unreadable."""
    try:
        origin = json.loads(path.read_text(encoding="utf-8"))
        check_version(origin, FORMAT, path)
        origin.pop(VERSION, None)
    except (OSError, ValueError, AttributeError, RecursionError, InputError):
        return None
    return origin
