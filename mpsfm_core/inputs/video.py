"""Photos from a video: frames that are sharp, and as far apart as matching allows."""

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
from mpsfm_core.providers.weights import file_sha256
from mpsfm_core.support.files import replacing
from mpsfm_core.support.format_versions import VERSION, check_version

EXTENSIONS = frozenset((".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp", ".wmv"))
"""File names that count as videos."""
FRAMES = "frames"
"""Subfolder of the output that holds the chosen frames."""

Progress = Callable[[int, int], None]
"""Called with the frames decoded so far and their number as the file announces it."""

_log = logging.getLogger(__name__)

_LIST = "frames.json"
FORMAT = 1
"""Of the list of frames."""
_TRACKED_SIDE = 480
"""Longer side in pixels of the frames that are tracked."""
_POINTS = 300
_SHARP_SIDE = 960
"""Longer side in pixels of the frames whose sharpness is judged: motion blur shows there."""
_BACK_PX = 1.0
"""A point is lost when tracking it back does not return to it."""
_SOON = 0.5
"""Share of the way to the next frame from where on a sharper one may be taken instead."""
_FEWEST = 20
"""Fewer points cannot tell how far the camera went."""
_WAITING = 300
"""Frames that are kept to choose from; ten seconds of most videos."""
_CUT = 0.9
"""A file that has less than this share of the frames that it announces is cut off."""
_QUALITY = 95


def is_video(path: Path) -> bool:
    """Whether a path is called as a video, and is no folder."""
    return path.suffix.lower() in EXTENSIONS and not path.is_dir()


def extract_frames(
    video: Path, output: Path, options: VideoOptions, progress: Progress | None = None
) -> Path:
    """Write the chosen frames as JPEG files into ``output/frames``; returns that folder.

    They are called by the number of the frame. Frames that are there from the same video and
    options stay.

    Raises :class:`InputError` when the file is no video, is damaged, or shows no motion.
    """
    folder = output / FRAMES
    origin: dict[str, Any] = {"sha256": _digest(video), "options": options.model_dump(mode="json")}
    if _read_list(folder / _LIST) == origin:
        return folder
    origin[VERSION] = FORMAT
    chosen = choose_frames(video, options, progress)
    with replacing(output, (FRAMES,)) as fresh:
        (fresh / FRAMES).mkdir()
        for number, frame in _frames(video, frozenset(chosen)):
            path = fresh / FRAMES / f"frame_{number:06d}.jpg"
            encoded = cv2.imencode(path.suffix, frame, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            path.write_bytes(encoded.tobytes())
        (fresh / FRAMES / _LIST).write_text(json.dumps(origin), encoding="utf-8")
    return folder


def choose_frames(
    video: Path, options: VideoOptions, progress: Progress | None = None
) -> list[int]:
    """Numbers of the frames to take, in order.

    From each chosen frame points are tracked. The next one is taken where they have moved by
    ``options.motion`` or only ``options.overlap`` of them are left, or shortly before if a frame
    there is sharper. A camera that stands still gives one frame.

    Raises as :func:`extract_frames`.
    """
    announced = _announced(video)
    chooser = _Chooser(options)
    decoded = 0
    for number, frame in _frames(video):
        decoded = number + 1
        chooser.see(_Frame(number, _gray(frame, _TRACKED_SIDE), _sharpness(frame)))
        if progress is not None:
            progress(decoded, max(announced, decoded))
    if decoded < _CUT * announced:
        _log.warning("%s is cut off: it has %d of %d frames", video, decoded, announced)
    chosen = chooser.finish()
    if len(chosen) < 2:
        raise InputError(
            f"{video}: in its {decoded} frames the camera hardly moves: a reconstruction needs "
            f"views from several places"
        )
    if len(chosen) > options.max_frames:
        text = "%s: %d frames would do, %d evenly spread ones are taken (inputs.video.max_frames)"
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
    """Follows points from the last chosen frame, and keeps what may become the next one."""

    options: VideoOptions
    chosen: list[int] = field(default_factory=list)
    _track: _Track | None = None
    _waiting: list[tuple[float, _Frame]] = field(default_factory=list)

    def see(self, frame: _Frame) -> None:
        """The next frame of the video."""
        if self._track is None:
            self._take(frame)
            return
        way = self._track.follow(frame.gray, self.options)
        if way < _SOON:
            self._waiting.clear()  # back where the last one was taken
            if (
                len(self.chosen) == 1
                and frame.sharpness > self._track.sharpness
                and way < _SOON / 2
            ):
                self.chosen.clear()  # a better start, from the same place
                self._take(frame)
            return
        self._waiting.append((way, frame))
        if way >= 1 or len(self._waiting) >= _WAITING:
            self._take_sharpest()

    def finish(self) -> list[int]:
        """What was chosen, with the end of the video."""
        while self._waiting:
            self._take_sharpest()
        return self.chosen

    def _take_sharpest(self) -> None:
        best = max(range(len(self._waiting)), key=lambda i: self._waiting[i][1].sharpness)
        later = [frame for _, frame in self._waiting[best + 1 :]]
        frame = self._waiting[best][1]
        self._waiting = []
        self._take(frame)
        for following in later:
            self.see(following)

    def _take(self, frame: _Frame) -> None:
        self.chosen.append(frame.number)
        self._track = _Track(frame)


class _Track:
    """Points of a frame on their way through the frames that follow."""

    def __init__(self, frame: _Frame) -> None:
        self.sharpness = frame.sharpness
        found = cv2.goodFeaturesToTrack(frame.gray, _POINTS, 0.01, 5)
        none = np.zeros((0, 1, 2), np.float32)
        self._start: Float32 = none if found is None else np.asarray(found, np.float32)
        self._now = self._start
        self._count = len(self._start)
        self._last = frame.gray

    def follow(self, gray: UInt8, options: VideoOptions) -> float:
        """How far the camera is on the way to the next frame: 1 where it should be taken."""
        height, width = gray.shape
        if len(self._now) >= _FEWEST:
            there, ok, _ = cv2.calcOpticalFlowPyrLK(self._last, gray, self._now, None)
            back, ok_back, _ = cv2.calcOpticalFlowPyrLK(gray, self._last, there, None)
            kept = (ok.ravel() > 0) & (ok_back.ravel() > 0)
            kept &= np.linalg.norm(back - self._now, axis=2).ravel() < _BACK_PX
            x, y = there[:, 0, 0], there[:, 0, 1]
            kept &= (x >= 0) & (y >= 0) & (x < width) & (y < height)
            self._start, self._now = self._start[kept], there[kept]
        self._last = gray
        if len(self._now) < _FEWEST:
            # Nothing to follow: a blank wall, or a cut. What comes may be anything.
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
    """Variance of the Laplacian (Pech-Pacheco et al. 2000)."""
    return float(cv2.Laplacian(_gray(frame, _SHARP_SIDE), cv2.CV_32F).var())


def _frames(video: Path, wanted: frozenset[int] | None = None) -> Iterator[tuple[int, UInt8]]:
    """Number and upright BGR pixels of the wanted frames, or of all."""
    with _opened(video) as capture:
        number = 0
        while capture.grab() and (wanted is None or number <= max(wanted)):
            if wanted is None or number in wanted:
                ok, frame = capture.retrieve()
                if ok and frame is not None and frame.size:
                    yield number, frame
            number += 1


def _announced(video: Path) -> int:
    with _opened(video) as capture:
        return max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # it would print what we say better
    try:
        capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    except cv2.error as error:
        raise InputError(f"video {video} cannot be opened: {error.err}") from error
    try:
        if not capture.isOpened():
            raise InputError(f"{video} cannot be decoded: it is damaged, or no video")
        yield capture
    finally:
        capture.release()


def _digest(video: Path) -> str:
    try:
        return file_sha256(video)
    except OSError as error:
        raise InputError(f"video {video} cannot be read: {error.strerror or error}") from error


def _read_list(path: Path) -> object:
    """What a folder of frames was made from; None if nobody can tell."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        check_version(found, FORMAT, path)
        found.pop(VERSION, None)
    except (OSError, ValueError, AttributeError, RecursionError, InputError):
        return None
    return found
