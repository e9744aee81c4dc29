"""Localize all frames of a video between the keyframes of a reconstruction."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Float64, Pose, UInt8
from mpsfm_core.data.decisions import FrameReason, Reason
from mpsfm_core.geometry import compose, invert
from mpsfm_core.inputs.images import SourceImage
from mpsfm_core.inputs.video import (
    Progress,
    SelectedFrame,
    VideoFrame,
    VideoSelection,
    gray_image,
    read_frames,
)
from mpsfm_core.mapping.frame_localization import (
    FrameCamera,
    FramePose,
    Keyframe,
    localize_frame,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.mapping.trajectory_smoothing import interpolate_pose, smooth_trajectory
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.trajectory import TrajectoryFrame

TRACKED_SIDE = 1280
"""Maximum longer side in pixels of the frames in which points are tracked. [ours]"""
MAX_GAP_S = 1.0
"""Longest gap in seconds whose frames are interpolated, and longest time to the nearest keyframe of
a frame that has keyframes on one side only. [ours]"""


class _Neighbors(NamedTuple):
    """Registered keyframes before and after a frame in the same component and shot."""

    component: int
    frames: tuple[SelectedFrame, ...]


@dataclass(frozen=True, eq=False)
class _LocalizedFrame:
    """Frame with its localization."""

    frame: TrajectoryFrame
    measured: tuple[Pose, Float64] | None
    """Pose and covariance from tracked points, before smoothing."""
    shot: int
    inflation: float = 1.0
    """Factor of the smoothed covariance, see :class:`FramePose`."""


def localize_frames(
    video: Path,
    selection: VideoSelection,
    components: Sequence[Reconstruction],
    originals: OriginalImages,
    every: int = 1,
    progress: Progress | None = None,
    subfolder: str = "",
) -> list[TrajectoryFrame]:
    """Estimate the poses of the frames of a video, which is read frame by frame.

    Args:
        video: Path of the video.
        selection: Keyframes of the video.
        components: Reconstructed components, the largest first.
        originals: Original images of the keyframes.
        every: Interval of the frames that are localized, in addition to the keyframes.
        progress: Callback with the number of read frames and the number of all frames.
        subfolder: Folder of the keyframes in the names of the images, empty for a single video.

    Returns:
        The localized frames and the frames without pose, ascending by number.
    """
    localizer = _FrameLocalizer(selection, components, originals, PurePosixPath(subfolder))
    placed = []
    keyframes = frozenset(selection.numbers)
    for frame in read_frames(video):
        if frame.number % every == 0 or frame.number in keyframes:
            placed.append(localizer.localize(frame))
        if progress is not None:
            progress(frame.number + 1, max(selection.num_frames, frame.number + 1))
    return [frame for run in _split_at_gaps(placed) for frame in _smooth(run)]


class _FrameLocalizer:
    """Localizer of frames in ascending order, by the keyframes before and after each frame."""

    def __init__(
        self,
        selection: VideoSelection,
        components: Sequence[Reconstruction],
        originals: OriginalImages,
        folder: PurePosixPath,
    ) -> None:
        self._folder = folder
        self._keyframes = selection.keyframes
        self._numbers = np.array(selection.numbers)
        self._originals = originals
        self._registered: Mapping[str, tuple[int, Reconstruction, RegisteredImage]] = {
            image.name: (number, part, image)
            for number, part in reversed(list(enumerate(components)))
            for image in part.confirmed_images
        }
        self._read_keyframe = lru_cache(maxsize=3)(self._build_keyframe)
        self._last: tuple[_Neighbors, Pose, Pose] | None = None

    def localize(self, frame: VideoFrame) -> _LocalizedFrame:
        """Estimate the pose of a frame; frames come in ascending order."""
        after = int(np.searchsorted(self._numbers, frame.number, side="right"))
        shot = self._keyframes[max(after - 1, 0)].shot
        neighbors = self._find_neighbors(frame, after, shot)
        number, time_s = frame.number, frame.time_s
        if neighbors is None:
            reason = FrameReason.NO_KEYFRAME.because()
            return _LocalizedFrame(
                TrajectoryFrame(number, time_s, "none", reason=reason), None, shot
            )
        interpolated = self._interpolate(neighbors, time_s)
        gray = gray_image(frame.image, TRACKED_SIDE)
        keyframes = [self._read_keyframe(self._image_name(key)) for key in neighbors.frames]
        outcome: FramePose | Reason | None = None
        for predicted in self._predict(neighbors, interpolated):
            outcome = localize_frame(keyframes, gray, predicted)
            if isinstance(outcome, FramePose):
                break
        if not isinstance(outcome, FramePose):
            self._last = None
            placed = TrajectoryFrame(number, time_s, "none", neighbors.component, reason=outcome)
            return _LocalizedFrame(placed, None, shot)
        self._last = neighbors, interpolated, outcome.pose
        source = "keyframe" if neighbors.frames[0].number == number else "tracked"
        pose = keyframes[0].pose if source == "keyframe" else outcome.pose
        placed = TrajectoryFrame(
            *(number, time_s, source, neighbors.component), num_inliers=outcome.num_inliers
        )
        return _LocalizedFrame(placed, (pose, outcome.covariance), shot, outcome.inflation)

    def _image_name(self, keyframe: SelectedFrame) -> str:
        return (self._folder / keyframe.name).as_posix()

    def _find(self, keyframe: SelectedFrame) -> tuple[int, Reconstruction, RegisteredImage]:
        """Return a registered keyframe with its component and the number of the component."""
        return self._registered[self._image_name(keyframe)]

    def _find_neighbors(self, frame: VideoFrame, after: int, shot: int) -> _Neighbors | None:
        """Find the nearest registered keyframes of the shot, or only the frame if it is one."""
        before = self._search(range(after - 1, -1, -1), shot)
        following = self._search(range(after, len(self._keyframes)), shot)
        if before is not None and before.number == frame.number:
            return _Neighbors(self._find(before)[0], (before,))
        near = [key for key in (before, following) if key is not None]
        near.sort(key=lambda key: abs(key.time_s - frame.time_s))
        if not near or (len(near) == 1 and abs(near[0].time_s - frame.time_s) > MAX_GAP_S):
            return None
        component = self._find(near[0])[0]
        same = [key for key in near if self._find(key)[0] == component]
        return _Neighbors(component, tuple(sorted(same, key=lambda key: key.number)))

    def _search(self, rows: range, shot: int) -> SelectedFrame | None:
        """Return the first registered keyframe in the order of ``rows``, within the shot."""
        for row in rows:
            keyframe = self._keyframes[row]
            if keyframe.shot != shot:
                return None
            if self._image_name(keyframe) in self._registered:
                return keyframe
        return None

    def _interpolate(self, neighbors: _Neighbors, time_s: float) -> Pose:
        images = [self._find(key)[2] for key in neighbors.frames]
        poses = [(image.rotation, image.translation) for image in images]
        if len(poses) == 1:
            return poses[0]
        first, second = neighbors.frames
        ratio = (time_s - first.time_s) / (second.time_s - first.time_s)
        return interpolate_pose(poses[0], poses[1], ratio)

    def _predict(self, neighbors: _Neighbors, interpolated: Pose) -> Iterator[Pose]:
        """Yield the interpolated pose, first corrected by the last frame's deviation from it."""
        if self._last is not None and self._last[0] == neighbors:
            _, last_interpolated, last = self._last
            yield compose(compose(last, invert(*last_interpolated)), interpolated)
        yield interpolated

    def _build_keyframe(self, name: str) -> Keyframe:
        """Read a keyframe, and select the points to track."""
        _, part, image = self._registered[name]
        source = self._originals.source(image)
        pixels = cv2.imread(str(source.path), cv2.IMREAD_COLOR)
        assert pixels is not None
        gray = gray_image(np.asarray(pixels, np.uint8), TRACKED_SIDE)
        keypoints = self._originals.problem.images[image.index].keypoints
        observed = image.point_ids >= 0
        return Keyframe.build(
            gray,
            _frame_camera(source, image, gray),
            (image.rotation, image.translation),
            (keypoints[observed], part.points[image.point_ids[observed]]),
            image.depth,
        )


def _frame_camera(source: SourceImage, image: RegisteredImage, gray: UInt8) -> FrameCamera:
    """Return the camera of a keyframe, in pixels of the gray image."""
    scale = gray.shape[1] / source.original_size[0]
    return FrameCamera(
        image.camera,
        lambda xy: scale * source.original_pixels(xy),
        lambda xy: source.view_pixels(xy / scale),
    )


def _split_at_gaps(placed: Sequence[_LocalizedFrame]) -> Iterator[list[_LocalizedFrame]]:
    """Split frames into sequences of one component and one shot, with gaps of at most MAX_GAP_S."""
    run: list[_LocalizedFrame] = []
    pending: deque[_LocalizedFrame] = deque()
    for entry in placed:
        if entry.measured is None:
            pending.append(entry)
            continue
        if run:
            last = run[-1]
            same = last.frame.component == entry.frame.component and last.shot == entry.shot
            if not same or entry.frame.time_s - last.frame.time_s > MAX_GAP_S:
                yield run
                run = []
        if not run:
            for gap in pending:
                yield [gap]
            pending.clear()
        run += [*pending, entry]
        pending.clear()
    if run:
        yield run
    for gap in pending:
        yield [gap]


def _smooth(run: Sequence[_LocalizedFrame]) -> Iterator[TrajectoryFrame]:
    """Yield the frames of a run with smoothed poses, and with interpolated poses in gaps."""
    if run[0].measured is None:
        yield run[0].frame
        return
    smoothed = smooth_trajectory(
        [entry.frame.time_s for entry in run], [entry.measured for entry in run]
    )
    typical = float(np.median([entry.inflation for entry in run if entry.measured is not None]))
    for entry, result in zip(run, smoothed, strict=True):
        is_measured = entry.measured is not None
        yield replace(
            entry.frame,
            source=entry.frame.source if is_measured else "interpolated",
            component=run[0].frame.component,
            pose=result.pose,
            covariance=result.covariance * (entry.inflation if is_measured else typical),
        )
