"""Localize all frames of a video between the keyframes of a reconstruction."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

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
from mpsfm_core.inputs.view_cutting import CutImages
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
FUSION_ITERATIONS = 10
"""Number of IRLS iterations of the fusion of the poses that the views of a frame give. [ours]"""


class _FrameViews(NamedTuple):
    """Perspective views into which the frames of a video are cut, or the frames themselves."""

    names: Mapping[str, tuple[str, ...]]
    """Names of the views of each keyframe."""
    rotations: Float64
    """(n, 3, 3) rotation ``view_from_frame`` of each view."""
    cut: Callable[[UInt8], list[UInt8]]
    """Function that cuts a frame into its views."""


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
    cut: CutImages | None = None,
) -> list[TrajectoryFrame]:
    """Estimate the poses of the frames of a video, which is read frame by frame.

    The frames of a panorama or wide fisheye video are cut into views like its keyframes. The poses
    that the views give are fused to the pose of the frame.

    Args:
        video: Path of the video.
        selection: Keyframes of the video.
        components: Reconstructed components, the largest first.
        originals: Original images of the keyframes.
        every: Interval of the frames that are localized, in addition to the keyframes.
        progress: Callback with the number of read frames and the number of all frames.
        subfolder: Folder of the keyframes in the names of the images, empty for a single video.
        cut: Views of the keyframes, None if the keyframes are not cut.

    Returns:
        The localized frames and the frames without pose, ascending by number.
    """
    views = _make_frame_views(selection, PurePosixPath(subfolder), cut)
    localizer = _FrameLocalizer(selection, components, originals, views)
    placed = []
    keyframes = frozenset(selection.numbers)
    for frame in read_frames(video):
        if frame.number % every == 0 or frame.number in keyframes:
            placed.append(localizer.localize(frame))
        if progress is not None:
            progress(frame.number + 1, max(selection.num_frames, frame.number + 1))
    return [frame for run in _split_at_gaps(placed) for frame in _smooth(run)]


def _make_frame_views(
    selection: VideoSelection, folder: PurePosixPath, cut: CutImages | None
) -> _FrameViews:
    """Return the views by which frames are localized: few views that cover all directions."""
    names = {key.name: (folder / key.name).as_posix() for key in selection.keyframes}
    cutter = cut.cutters[next(iter(names.values()))] if cut is not None and names else None
    if cut is None or cutter is None:
        own_names = {key: (name,) for key, name in names.items()}
        return _FrameViews(own_names, np.eye(3)[None], lambda frame: [frame])
    numbers = list(cutter.tiling)
    view_names = {key: tuple(cut.view_names[n][k] for k in numbers) for key, n in names.items()}
    return _FrameViews(view_names, cutter.rotations[numbers], partial(cutter.cut, numbers=numbers))


class _FrameLocalizer:
    """Localizer of frames in ascending order, by the keyframes before and after each frame."""

    def __init__(
        self,
        selection: VideoSelection,
        components: Sequence[Reconstruction],
        originals: OriginalImages,
        views: _FrameViews,
    ) -> None:
        self._views = views
        self._keyframes = selection.keyframes
        self._numbers = np.array(selection.numbers)
        self._originals = originals
        self._registered: Mapping[str, tuple[int, Reconstruction, RegisteredImage]] = {
            image.name: (number, part, image)
            for number, part in reversed(list(enumerate(components)))
            for image in part.confirmed_images
        }
        count = len(views.rotations)
        self._read_keyframe = lru_cache(maxsize=3 * count)(self._build_keyframe)
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
        grays = [gray_image(view, TRACKED_SIDE) for view in self._views.cut(frame.image)]
        outcome: FramePose | Reason | None = None
        for predicted in self._predict(neighbors, interpolated):
            outcome = self._localize_views(neighbors, grays, predicted)
            if isinstance(outcome, FramePose):
                break
        if not isinstance(outcome, FramePose):
            self._last = None
            placed = TrajectoryFrame(number, time_s, "none", neighbors.component, reason=outcome)
            return _LocalizedFrame(placed, None, shot)
        self._last = neighbors, interpolated, outcome.pose
        source = "keyframe" if neighbors.frames[0].number == number else "tracked"
        pose = interpolated if source == "keyframe" else outcome.pose
        placed = TrajectoryFrame(
            *(number, time_s, source, neighbors.component), num_inliers=outcome.num_inliers
        )
        return _LocalizedFrame(placed, (pose, outcome.covariance), shot, outcome.inflation)

    def _localize_views(
        self, neighbors: _Neighbors, grays: Sequence[UInt8], predicted: Pose
    ) -> FramePose | Reason | None:
        """Localize the views of a frame, and fuse the poses of the frame that they give."""
        poses: list[FramePose] = []
        reason: Reason | None = None
        for number, (rotation, gray) in enumerate(zip(self._views.rotations, grays, strict=True)):
            names = [self._views.names[key.name][number] for key in neighbors.frames]
            keyframes = [self._read_keyframe(name) for name in names if name in self._registered]
            if not keyframes:
                continue
            outcome = localize_frame(keyframes, gray, _turn(rotation, predicted))
            if isinstance(outcome, Reason):
                reason = outcome
            else:
                poses.append(_turn_frame_pose(rotation.T, outcome))
        return _fuse_poses(poses) if poses else reason

    def _find_neighbors(self, frame: VideoFrame, after: int, shot: int) -> _Neighbors | None:
        """Find the nearest registered keyframes of the shot, or only the frame if it is one."""
        before = self._search(range(after - 1, -1, -1), shot)
        following = self._search(range(after, len(self._keyframes)), shot)
        if before is not None and before.number == frame.number:
            return _Neighbors(self._find_image(before)[1][0], (before,))
        near = [key for key in (before, following) if key is not None]
        near.sort(key=lambda key: abs(key.time_s - frame.time_s))
        if not near or (len(near) == 1 and abs(near[0].time_s - frame.time_s) > MAX_GAP_S):
            return None
        component = self._find_image(near[0])[1][0]
        same = [key for key in near if self._find_image(key)[1][0] == component]
        return _Neighbors(component, tuple(sorted(same, key=lambda key: key.number)))

    def _search(self, rows: range, shot: int) -> SelectedFrame | None:
        """Return the first registered keyframe in the order of ``rows``, within the shot."""
        for row in rows:
            keyframe = self._keyframes[row]
            if keyframe.shot != shot:
                return None
            if any(name in self._registered for name in self._views.names[keyframe.name]):
                return keyframe
        return None

    def _find_image(
        self, keyframe: SelectedFrame
    ) -> tuple[int, tuple[int, Reconstruction, RegisteredImage]]:
        """Return the number of the first registered view of a keyframe, and its registration."""
        names = self._views.names[keyframe.name]
        number = next(k for k, name in enumerate(names) if name in self._registered)
        return number, self._registered[names[number]]

    def _keyframe_pose(self, keyframe: SelectedFrame) -> Pose:
        """Return the pose ``frame_from_world`` of a registered keyframe."""
        number, (_, _, image) = self._find_image(keyframe)
        pose = image.rotation, image.translation
        return (
            pose
            if len(self._views.rotations) == 1
            else _turn(self._views.rotations[number].T, pose)
        )

    def _interpolate(self, neighbors: _Neighbors, time_s: float) -> Pose:
        poses = [self._keyframe_pose(key) for key in neighbors.frames]
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


def _turn(rotation: Float64, pose: Pose) -> Pose:
    """Rotate the camera frame of a pose."""
    return rotation @ pose[0], rotation @ pose[1]


def _turn_frame_pose(rotation: Float64, localized: FramePose) -> FramePose:
    """Rotate the camera frame of a pose with its covariance."""
    turn = np.kron(np.eye(2), rotation)
    covariance = turn @ localized.covariance @ turn.T
    return replace(localized, pose=_turn(rotation, localized.pose), covariance=covariance)


def _fuse_poses(poses: Sequence[FramePose]) -> FramePose:
    """Return the mean of poses of one frame, weighted by their information, with a Cauchy loss.

    The IRLS starts from the pose with the most inliers.
    """
    if len(poses) == 1:
        return poses[0]
    best = max(poses, key=lambda pose: pose.num_inliers)
    rotation, translation = best.pose
    information = np.linalg.inv([pose.inflation * pose.covariance for pose in poses])
    for _ in range(FUSION_ITERATIONS):
        turns = Rotation.from_matrix([pose.pose[0] @ rotation.T for pose in poses]).as_rotvec()
        shifts = np.array([pose.pose[1] - translation for pose in poses])
        errors = np.concatenate([turns, shifts], axis=1)
        squared = np.einsum("ni,nij,nj->n", errors, information, errors) / errors.shape[1]
        weighted = information / (1.0 + squared)[:, None, None]
        covariance = np.linalg.inv(weighted.sum(axis=0))
        step = covariance @ np.einsum("nij,nj->i", weighted, errors)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        translation = translation + step[3:]
    return FramePose(
        (rotation, translation), covariance, sum(pose.num_inliers for pose in poses), 1.0
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
