"""Select sharp frames of a video, as far apart as matching allows."""

from __future__ import annotations

import heapq
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Float32, UInt8
from mpsfm_core.data.decisions import KeyframeReason, Reason, reason_from_json
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.optical_flow import track_points
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.inputs.telemetry import Telemetry, read_telemetry
from mpsfm_core.providers.weights import file_sha256
from mpsfm_core.support.files import replace_entries
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.jpeg import encode_jpeg

EXTENSIONS = frozenset((".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp", ".wmv"))
"""File extensions of videos."""
FRAMES = "frames"
"""Subfolder of the output folder with the selected video frames."""

Progress = Callable[[int, int], None]
"""Progress callback with the number of decoded frames and the number in the video header."""

_log = logging.getLogger(__name__)

_LIST = "frames.json"
FORMAT = 1
"""Format version of ``frames.json``, the origin and the reasons of the selected frames."""
_ORIGIN = "sha256", "options", "telemetry"
"""Fields of ``frames.json`` that identify the video, the options and the GPS positions."""
_TRACKED_SIDE = 480
"""Longer side in pixels of the downscaled frames in which points are tracked."""
_MAX_POINTS = 300
"""Maximum number of points tracked by Lucas-Kanade optical flow."""
_SHARPNESS_SIDE = 960
"""Longer side in pixels of the downscaled frames whose sharpness is measured."""
_EARLY_RATIO = 0.5
"""Share of the required motion from which an earlier, sharper frame may be selected instead."""
_MIN_POINTS = 20
"""Minimum number of tracked points to measure the motion of a frame."""
_MAX_CANDIDATES = 300
"""Maximum number of candidate frames in memory, ten seconds of most videos."""
_NUM_KEYFRAMES, _MAX_KEYFRAMES = 300, 1000
"""Number of keyframes from which keyframes are dropped if ``max_frames`` is null, and the maximum
number if neighbors need more to overlap. Extraction and bundle adjustment of 760 keyframes of
480 x 360 pixels take 2.7 GB of memory, of which 0.9 GB are mapped files. [ours]"""
_MAX_MOTION = 0.32
"""Maximum motion between neighbors after keyframes are dropped, relative to the image diagonal.
[tuned: benchmarks.walks]"""
_MAX_CUT_RATIO = 0.2
"""Share of the points that are tracked from one frame to the next below which there may be a cut.
[ours]"""
_MAX_CUT_CORRELATION = 0.5
"""Maximum correlation of the thumbnails of two successive frames at a cut. The thumbnails are
compared if points cannot be tracked from one frame to the next. [ours]"""
_MIN_COMMON_KEYPOINTS = 30
"""Minimum number of homography inliers among the SIFT matches of two successive frames that shows
that the camera turned fast and there is no cut. [tuned: benchmarks.walks]"""
_MAX_CUT_KEYPOINTS = 1000
"""Maximum number of SIFT keypoints per frame, with which a possible cut between two frames is
checked."""
_MAX_MATCH_RATIO = 0.8
"""Maximum distance ratio of the nearest to the second nearest descriptor of a SIFT match. [Lowe
2004]"""
_MAX_HOMOGRAPHY_ERROR_PX = 5.0
"""Maximum distance of a matched keypoint from the keypoint that the homography transfers from the
other frame, for an inlier, in pixels of the downscaled frames. [ours]"""
_MIN_CONTRAST = 4.0
"""Minimum std of the gray levels of a frame before or after a cut, so that a black
frame is no cut."""
_THUMBNAIL = 16, 12
"""Size of the thumbnails that are correlated to detect cuts."""
_DEFAULT_FPS = 30.0
"""Frame rate of a video whose container has neither time stamps nor a frame rate."""
_MIN_FRAME_RATIO = 0.9
"""Minimum ratio of decoded frames to the frame count in the header of an undamaged video."""


def is_video(path: Path) -> bool:
    """Return whether a path has a video extension and is not a folder."""
    return path.suffix.lower() in EXTENSIONS and not path.is_dir()


@dataclass(frozen=True)
class SelectedFrame:
    """Keyframe of a video."""

    number: int
    """Number of the frame in the video, from 0."""
    time_s: float
    """Time stamp of the frame in the container, in seconds."""
    shot: int
    """Number of the shot, from 0, which a cut separates from the next shot."""
    reason: Reason
    """Reason (``KeyframeReason``) why the frame is a keyframe."""
    sharpness: float
    """Variance of the Laplacian."""
    motion: float
    """Motion since the previous keyframe, relative to the motion that makes a keyframe."""

    @property
    def name(self) -> str:
        """File name with the number of the frame."""
        return f"frame_{self.number:06d}.jpg"

    def to_json(self) -> dict[str, Any]:
        """Convert the keyframe to an entry of ``frames.json``."""
        return {**vars(self), "reason": self.reason.to_json()}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> SelectedFrame:
        """Read an entry of ``frames.json``."""
        return cls(**{**entry, "reason": reason_from_json(KeyframeReason, entry["reason"])})


@dataclass(frozen=True)
class VideoSelection:
    """Keyframes of a video, and what was found while reading the video."""

    keyframes: tuple[SelectedFrame, ...]
    num_frames: int
    """Number of decoded frames."""
    duration_s: float
    """Time stamp of the last frame in seconds."""
    num_over_budget: int = 0
    """Number of keyframes that were dropped to limit their number."""

    @property
    def numbers(self) -> list[int]:
        """Frame numbers of the keyframes, ascending."""
        return [frame.number for frame in self.keyframes]

    def describe(self) -> dict[str, Any]:
        """Describe the selection for ``summary.json``."""
        reasons = [frame.reason.code.value for frame in self.keyframes]
        shots = {frame.shot: frame for frame in reversed(self.keyframes)}
        return {
            "frames": self.num_frames,
            "duration_s": self.duration_s,
            "keyframes": len(self.keyframes),
            "keyframe_reasons": {code: reasons.count(code) for code in dict.fromkeys(reasons)},
            "keyframes_over_budget": self.num_over_budget,
            "cuts_s": [shots[shot].time_s for shot in sorted(shots) if shot],
        }


def extract_frames(
    videos: Mapping[str, Path],
    output: Path,
    options: VideoOptions,
    progress: Progress | None = None,
) -> Path:
    """Select frames of videos and write them as JPEG files into ``output/frames``.

    The name of a JPEG file contains the frame number. EXIF of the JPEG file has the GPS position if
    a drone or action camera recorded positions (see :func:`read_telemetry`). Existing frames of the
    same video and options are reused.

    Args:
        videos: video files by the subfolder of their frames, which is empty for a single video.
        output: output folder.
        options: options of the frame selection.
        progress: callback during decoding of each video.

    Returns:
        Path of the folder with the JPEG files or the subfolders.

    Raises:
        InputError: a file is not a video or is damaged, or the camera does not move.
    """
    folder = output / FRAMES
    selected = options.model_dump(mode="json", exclude={"trajectory_every"})
    telemetry = {name: read_telemetry(video) for name, video in videos.items()}
    origins = {}
    for name, video in videos.items():
        digest = telemetry[name].digest if telemetry[name].points else None
        origins[name] = dict(zip(_ORIGIN, (_digest(video), selected, digest), strict=True))
    stored = {path.parent.relative_to(folder) for path in folder.rglob(_LIST)}
    unchanged = {name for name in videos if _read_origin(folder / name) == origins[name]}
    if unchanged == set(videos) and len(stored) == len(videos):
        return folder
    with replace_entries(output, (FRAMES,)) as fresh:
        for name, video in videos.items():
            target = fresh / FRAMES / name
            target.mkdir(parents=True, exist_ok=True)
            if name in unchanged:
                for file in filter(Path.is_file, (folder / name).iterdir()):
                    shutil.copyfile(file, target / file.name)
            else:
                selection = choose_frames(video, options, progress)
                _write_keyframes(video, target, selection, telemetry[name], origins[name])
    return folder


def _write_keyframes(
    video: Path,
    folder: Path,
    selection: VideoSelection,
    telemetry: Telemetry,
    origin: Mapping[str, Any],
) -> None:
    """Write the keyframes of one video and their list into a folder."""
    names = {frame.number: frame.name for frame in selection.keyframes}
    for frame in read_frames(video, frozenset(names)):
        path = folder / names[frame.number]
        path.write_bytes(telemetry.add_exif(encode_jpeg(frame.image), frame.number))
    content = {
        VERSION: FORMAT,
        **origin,
        **vars(selection),
        "keyframes": [frame.to_json() for frame in selection.keyframes],
    }
    (folder / _LIST).write_text(json.dumps(content, indent=1), encoding="utf-8")


def _read_origin(folder: Path) -> dict[str, Any] | None:
    """Read what identifies the video and the options of the frames in a folder, if any."""
    content = _read_list(folder / _LIST)
    return None if content is None else {key: content.get(key) for key in _ORIGIN}


def read_selection(folder: Path) -> VideoSelection:
    """Read the keyframes of one video from ``frames.json`` in the folder of its frames.

    Raises:
        InputError: the file is missing or damaged.
    """
    content = _read_list(folder / _LIST)
    try:
        if content is None:
            raise ValueError("the file is missing or has another format")
        keyframes = tuple(map(SelectedFrame.from_json, content["keyframes"]))
        names = ("num_frames", "duration_s", "num_over_budget")
        return VideoSelection(keyframes, *(content[name] for name in names))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / _LIST}: the list of keyframes cannot be read ({error}); delete the folder "
            f"to extract the keyframes again"
        ) from error


def require_output_folder(path: Path, output: Path | None) -> Path:
    """Return the output folder for the frames of a video, or raise :class:`InputError` for None."""
    if output is None:
        raise InputError(f"{path}: the frames of a video need an output folder")
    return output


def choose_frames(
    video: Path, options: VideoOptions, progress: Progress | None = None
) -> VideoSelection:
    """Select keyframes of a video, which is read frame by frame.

    Points are tracked from each selected frame with Lucas-Kanade optical flow. The next frame is
    selected when the tracked points have moved by ``options.motion`` or only the share
    ``options.overlap`` of the points is still tracked. If an earlier frame nearby is sharper, the
    earlier frame is selected instead. A cut starts a new shot.

    Raises:
        InputError: as :func:`extract_frames`.
    """
    announced = _read_frame_count(video)
    chooser = _Chooser(options)
    decoded, duration_s = 0, 0.0
    for frame in read_frames(video):
        decoded, duration_s = frame.number + 1, frame.time_s
        gray, sharpness = gray_image(frame.image, _TRACKED_SIDE), _sharpness(frame.image)
        chooser.process(_Frame(frame.number, frame.time_s, gray, sharpness))
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
    kept = _limit_keyframes(video, chosen, options)
    return VideoSelection(tuple(kept), decoded, duration_s, len(chosen) - len(kept))


def _limit_keyframes(
    video: Path, frames: Sequence[SelectedFrame], options: VideoOptions
) -> list[SelectedFrame]:
    """Drop keyframes beyond ``max_frames``, and warn if neighbors may not overlap any more."""
    max_gap = max(1.0, _MAX_MOTION / options.motion)
    needed = thin_keyframes(frames, _NUM_KEYFRAMES, max_gap)
    limit = options.max_frames or _MAX_KEYFRAMES
    if options.max_frames is None and len(needed) <= limit:
        return needed
    kept = thin_keyframes(frames, limit)
    num_needed = len(thin_keyframes(frames, 2, max_gap))
    if len(kept) < num_needed:
        text = (
            "%s: %d keyframes are too few for this video, so neighboring keyframes may not "
            "overlap, and parts of the video may be missing; raise inputs.video.max_frames to %d, "
            "or cut the video into clips in one folder"
        )
        _log.warning(text, video, len(kept), num_needed)
    return kept


def thin_keyframes(
    frames: Sequence[SelectedFrame], count: int, max_motion: float = np.inf
) -> list[SelectedFrame]:
    """Drop the keyframes with the least motion to both neighbors until ``count`` remain.

    The first and the last keyframe of a shot remain as long as other keyframes can be dropped.

    Args:
        frames: Keyframes of a video, ascending.
        count: Number of keyframes that remain, or more if ``max_motion`` does not allow to drop
            them.
        max_motion: Maximum motion between neighbors in the same shot after a keyframe is dropped,
            as :attr:`SelectedFrame.motion`.
    """
    motion = [frame.motion for frame in frames]
    before, after = list(range(-1, len(frames) - 1)), list(range(1, len(frames) + 1))

    def cost(row: int) -> float:
        inner = before[row] >= 0 and after[row] < len(frames)
        inner = inner and frames[before[row]].shot == frames[after[row]].shot
        return motion[row] + motion[after[row]] if inner else np.inf

    heap = [(cost(row), row) for row in range(len(frames))]
    heapq.heapify(heap)
    dropped: set[int] = set()
    while len(frames) - len(dropped) > count:
        value, row = heapq.heappop(heap)
        if value > max_motion:
            break
        if row in dropped or value != cost(row):
            continue  # the cost has changed since the entry was pushed
        dropped.add(row)
        previous, following = before[row], after[row]
        if following < len(frames):
            motion[following] += motion[row]
            before[following] = previous
        if previous >= 0:
            after[previous] = following
        for neighbor in (previous, following):
            if 0 <= neighbor < len(frames):
                heapq.heappush(heap, (cost(neighbor), neighbor))
    return [frame for row, frame in enumerate(frames) if row not in dropped]


@dataclass(frozen=True, eq=False)
class _Frame:
    number: int
    time_s: float
    gray: UInt8
    sharpness: float


@dataclass
class _Chooser:
    """Selector of frames by the motion of points tracked from the last selected frame."""

    options: VideoOptions
    chosen: list[SelectedFrame] = field(default_factory=list)
    _track: _Track | None = None
    _candidates: list[tuple[_Motion, _Frame]] = field(default_factory=list)
    _shot: int = 0

    def process(self, frame: _Frame) -> None:
        """Track points into the next frame of the video and select frames."""
        if self._track is None:
            self._take(frame, _Motion(0.0, KeyframeReason.FIRST.because()))
            return
        motion = self._track.follow(frame.gray, self.options)
        if motion.reason.code is KeyframeReason.CUT:
            self._start_shot(frame, motion)
            return
        if motion.ratio < _EARLY_RATIO:
            self._candidates.clear()  # the camera is back at the last selected frame
            first = self.chosen[-1]
            if (
                (len(self.chosen) == 1 or self.chosen[-2].shot != first.shot)
                and frame.sharpness > self._track.sharpness
                and motion.ratio < _EARLY_RATIO / 2
            ):
                self.chosen.pop()  # replace the first frame of the shot by a sharper frame
                self._take(frame, _Motion(0.0, first.reason))
            return
        self._candidates.append((motion, frame))
        if motion.ratio >= 1 or len(self._candidates) >= _MAX_CANDIDATES:
            self._take_sharpest()

    def finish(self) -> list[SelectedFrame]:
        """Select from the remaining candidate frames; return all selected frames."""
        while self._candidates:
            self._take_sharpest()
        return self.chosen

    def _start_shot(self, frame: _Frame, motion: _Motion) -> None:
        """Finish the shot before a cut, and select the first frame of the next shot."""
        while self._candidates:
            self._take_sharpest()
        self._shot += 1
        self._take(frame, motion)

    def _take_sharpest(self) -> None:
        best = max(range(len(self._candidates)), key=lambda i: self._candidates[i][1].sharpness)
        later = [frame for _, frame in self._candidates[best + 1 :]]
        motion, frame = self._candidates[best]
        trigger = self._candidates[-1][0].reason
        self._candidates = []
        self._take(frame, _Motion(motion.ratio, trigger))
        for following in later:
            self.process(following)

    def _take(self, frame: _Frame, motion: _Motion) -> None:
        self.chosen.append(
            SelectedFrame(
                frame.number, frame.time_s, self._shot, motion.reason, frame.sharpness, motion.ratio
            )
        )
        self._track = _Track(frame)


class _Motion(NamedTuple):
    """Motion since the last keyframe."""

    ratio: float
    """Motion relative to the motion that makes a keyframe."""
    reason: Reason
    """Reason (``KeyframeReason``) of a keyframe with this motion."""


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

    def follow(self, gray: UInt8, options: VideoOptions) -> _Motion:
        """Track points into a frame, and measure their motion since the keyframe."""
        height, width = gray.shape
        count = len(self._now)
        if count >= _MIN_POINTS:
            there, tracked = track_points(self._last, gray, self._now)
            x, y = there[:, 0, 0], there[:, 0, 1]
            tracked &= (x >= 0) & (y >= 0) & (x < width) & (y < height)
            self._start, self._now = self._start[tracked], there[tracked]
        last, self._last = self._last, gray
        if len(self._now) < _MAX_CUT_RATIO * count and _is_cut(last, gray):
            return _Motion(1.0, KeyframeReason.CUT.because())
        if len(self._now) < _MIN_POINTS:
            # The motion is unknown, for example in front of a blank wall, so the frame is selected.
            reason = KeyframeReason.UNTRACKED.because(num_tracks=len(self._now))
            return _Motion(1.0, reason)
        moved = float(np.median(np.linalg.norm(self._now - self._start, axis=2)))
        moved_ratio = moved / float(np.hypot(width, height))
        tracked_ratio = len(self._now) / self._count
        by_motion = moved_ratio / options.motion
        by_overlap = (1 - tracked_ratio) / (1 - options.overlap)
        if by_motion >= by_overlap:
            return _Motion(by_motion, KeyframeReason.MOVED.because(motion_ratio=moved_ratio))
        reason = KeyframeReason.LOST_OVERLAP.because(tracked_ratio=tracked_ratio)
        return _Motion(by_overlap, reason)


def _is_cut(last: UInt8, gray: UInt8) -> bool:
    """Return whether there is a cut between two successive frames, after tracking has failed.

    There is none if the thumbnails correlate, or if enough SIFT matches fit one homography.
    """
    small = [
        cv2.resize(frame, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
        for frame in (last, gray)
    ]
    spread = [picture.std() for picture in small]
    if min(spread) < _MIN_CONTRAST:
        return False
    first, second = ((picture - picture.mean()) for picture in small)
    correlation = float((first * second).mean() / (spread[0] * spread[1]))
    if correlation >= _MAX_CUT_CORRELATION:
        return False
    return _count_common_keypoints(last, gray) < _MIN_COMMON_KEYPOINTS


def _count_common_keypoints(first: UInt8, second: UInt8) -> int:
    """Count the homography inliers among the SIFT matches of two gray images."""
    sift = cv2.SIFT.create(_MAX_CUT_KEYPOINTS)
    found = [sift.detectAndCompute(image, None) for image in (first, second)]
    if min(len(keypoints) for keypoints, _ in found) < _MIN_COMMON_KEYPOINTS:
        return 0
    nearest = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    matches = [a for a, b in nearest if a.distance < _MAX_MATCH_RATIO * b.distance]
    if len(matches) < _MIN_COMMON_KEYPOINTS:
        return 0
    source = np.array([found[0][0][match.queryIdx].pt for match in matches])
    target = np.array([found[1][0][match.trainIdx].pt for match in matches])
    _, inliers = cv2.findHomography(source, target, cv2.RANSAC, _MAX_HOMOGRAPHY_ERROR_PX)
    return 0 if inliers is None else int(inliers.sum())


def gray_image(frame: UInt8, side: int) -> UInt8:
    """Convert a BGR image to gray, downscaled to at most ``side`` pixels on its longer side."""
    factor = min(1.0, side / max(frame.shape[:2]))
    size = round(frame.shape[1] * factor), round(frame.shape[0] * factor)
    small = frame if factor == 1 else cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))


def _sharpness(frame: UInt8) -> float:
    """Measure sharpness by the variance of the Laplacian (Pech-Pacheco et al. 2000)."""
    return float(cv2.Laplacian(gray_image(frame, _SHARPNESS_SIDE), cv2.CV_32F).var())


class VideoFrame(NamedTuple):
    """Decoded frame of a video."""

    number: int
    """Number of the frame in the video, from 0."""
    time_s: float
    """Time stamp of the frame in seconds, larger than the time stamp of the previous frame."""
    image: UInt8
    """Upright BGR image (h, w, 3)."""


def read_frames(video: Path, wanted: frozenset[int] | None = None) -> Iterator[VideoFrame]:
    """Yield all frames of a video, or the frames with a number in ``wanted``.

    Time stamps are those of the container, so the frame rate may vary. If they do
    not ascend, a constant frame rate is assumed.
    """
    with _opened(video) as capture:
        step_s = 1 / (capture.get(cv2.CAP_PROP_FPS) or _DEFAULT_FPS)
        number, time_s = 0, -np.inf
        last = np.inf if wanted is None else max(wanted)
        while capture.grab() and number <= last:
            stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            time_s = stamp_s if stamp_s > time_s else max(time_s, -step_s) + step_s
            if wanted is None or number in wanted:
                ok, frame = capture.retrieve()
                if ok and frame is not None and frame.size:
                    yield VideoFrame(number, time_s, np.asarray(frame))
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


def _read_list(path: Path) -> dict[str, Any] | None:
    """Read the origin and the keyframes in ``frames.json``, None if unreadable or incomplete."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        check_version(content, FORMAT, path)
        content["keyframes"]
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError, InputError):
        return None
    return content
