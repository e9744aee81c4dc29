"""Localization of video frames between keyframes of a model.

Usage::

    keyframe = Keyframe.build(gray, camera, pose, (keypoints, points), depth)   # of the model
    outcome = localize_frame([previous, next], gray, predicted_pose)         # pose or reason

The points of a keyframe are 3D points that the keyframe observes, and corners with depth from the
depth map of the keyframe. Pyramidal Lucas-Kanade optical flow (Bouguet 2000) tracks the points
directly from the keyframe to the frame, so tracking errors do not accumulate. The optical flow
starts at the projections of the points with a predicted pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, PinholeCamera, Pose, UInt8
from mpsfm_core.data.decisions import FrameReason, Reason
from mpsfm_core.geometry import inside, project, rays, sample_nearest, scale_pixels, transform
from mpsfm_core.geometry.optical_flow import track_points
from mpsfm_core.optimize.resection import (
    FrameImage,
    RaySegments,
    linearize_pose,
    measure_segments,
    refine_pose,
)

MIN_INLIERS = 15
"""Minimum number of tracked points that fit the pose of a frame. [COLMAP min_num_inliers]"""
MAX_ERROR_PX = 4.0
"""Maximum distance between a tracked point and its projection. [COLMAP filter_max_reproj_error]"""
MAX_POINTS = 300
"""Maximum number of points of a keyframe that are tracked into each frame. [ours]"""
_MIN_DISTANCE_RATIO = 0.015
"""Minimum distance between two corners of a keyframe, relative to the image width."""
_DEPTH_DEVIATION = 2.0
"""Half length of the ray segment that contains a corner, in standard deviations of log depth.
[ours]"""
_SCALES = np.array([16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0])
"""Factors on :data:`MAX_ERROR_PX` in the steps of pose refinement, large at first because the
predicted pose may be wrong."""
_RAYLEIGH_MEDIAN = 1.1774
"""Ratio of the median distance to the std per axis of errors with a normal distribution."""
_CELL_RATIO = 0.25
"""Width of the cells in which the errors of all points of a keyframe are equal, because the depth
errors of neighboring points are, relative to the image width. [tuned: benchmarks.walks]"""
_MIN_STD_PX = 0.1
"""Minimum standard deviation of a tracked point in pixels, including the error of its 3D point.
[ours]"""
_CENTER = np.float32(0.5)
"""Coordinate of the center of the first pixel in COLMAP, which is 0 in OpenCV."""
PixelMap = Callable[[Float64], Float64]
"""Function that maps pixels (n, 2) to pixels (n, 2)."""


class FrameCamera(NamedTuple):
    """Camera of the frames of a video; undistorted frames are pinhole images."""

    pinhole: PinholeCamera
    """Intrinsics of the undistorted view."""
    distort: PixelMap
    """Maps pixels of the undistorted view to pixels of the frame."""
    undistort: PixelMap
    """Maps pixels of the frame to pixels of the undistorted view."""


@dataclass(frozen=True, eq=False)
class FramePose:
    """Pose of a video frame with its covariance."""

    pose: Pose
    """``cam_from_world`` as rotation (3, 3) and translation (3,)."""
    covariance: Float64
    """(6, 6) covariance of ``w`` and ``dt`` in ``R <- exp(w) R, t <- t + dt``, relative to the
    keyframes, for independent errors of all points."""
    num_inliers: int
    """Number of tracked points that fit the pose."""
    inflation: float
    """Factor of the covariance because the depth errors of neighboring points are equal. This part
    of the error is almost constant from frame to frame."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Keyframe with the points that are tracked into neighboring frames."""

    gray: UInt8
    """(h, w) gray image."""
    camera: FrameCamera
    pose: Pose
    """``cam_from_world``."""
    xy: Float32
    """(n, 2) pixels of the points in the keyframe."""
    near: Float64
    """(n, 3) near end of the ray segment that contains each point, in the world frame."""
    far: Float64
    """(n, 3) far end of the segment, equal to ``near`` for triangulated points."""

    @classmethod
    def build(
        cls,
        gray: UInt8,
        camera: FrameCamera,
        pose: Pose,
        observed: tuple[Float64, Float64],
        depth: DepthPrior,
    ) -> Keyframe:
        """Select the points of a keyframe: observed 3D points, then corners with valid depth.

        Args:
            gray: (h, w) gray image of the keyframe.
            camera: Camera of the keyframe.
            pose: ``cam_from_world`` of the keyframe.
            observed: Keypoints (n, 2) in pixels of the undistorted view, and the 3D points (n, 3)
                that they observe.
            depth: Refined depth map of the undistorted view, with variance.
        """
        keypoints, points = observed
        xy = camera.distort(keypoints)
        rows = _spread(xy, gray.shape[1], MAX_POINTS)
        xy, points = xy[rows], points[rows]
        corners, near, far = _lift_corners(gray, camera, pose, depth, xy)
        return cls(
            gray,
            camera,
            pose,
            np.concatenate([xy, corners]).astype(np.float32),
            np.concatenate([points, near]),
            np.concatenate([points, far]),
        )


def localize_frame(
    keyframes: Sequence[Keyframe], gray: UInt8, predicted: Pose
) -> FramePose | Reason:
    """Estimate the pose of a video frame by points that are tracked from keyframes.

    Args:
        keyframes: Keyframes nearby, at least one.
        gray: (h, w) gray image of the frame.
        predicted: Predicted ``cam_from_world`` of the frame.

    Returns:
        The pose, or the reason why the frame has no pose.
    """
    camera = keyframes[0].camera
    tracked = [_track(keyframe, gray, predicted) for keyframe in keyframes]
    xy = np.concatenate([part[0] for part in tracked])
    near = np.concatenate([part[1] for part in tracked])
    far = np.concatenate([part[2] for part in tracked])
    if len(xy) < MIN_INLIERS:
        return FrameReason.TOO_FEW_TRACKS.because(num_tracks=len(xy), min_tracks=MIN_INLIERS)
    segments = RaySegments(
        near,
        far,
        camera.undistort(xy.astype(np.float64)),
        np.full(len(xy), MAX_ERROR_PX),
        np.full(len(xy), MAX_ERROR_PX**2),
    )
    image = FrameImage((np.eye(3), np.zeros(3)), camera.pinhole.params, segments)
    pose = refine_pose(predicted, [image], scales=_SCALES)
    distances, _ = measure_segments(pose, camera.pinhole.params, segments)
    inlier = distances < MAX_ERROR_PX
    if inlier.sum() < MIN_INLIERS:
        count = int(inlier.sum())
        return FrameReason.TOO_FEW_INLIERS.because(num_inliers=count, min_inliers=MIN_INLIERS)
    matrix, gradient = np.empty((6, 6)), np.empty(6)
    rotation, translation = map(np.ascontiguousarray, pose)
    linearize_pose(rotation, translation, camera.pinhole.params, segments, 1.0, matrix, gradient)
    std_px = max(float(np.median(distances[inlier])) / _RAYLEIGH_MEDIAN, _MIN_STD_PX)
    source = np.repeat(np.arange(len(tracked)), [len(part[0]) for part in tracked])
    cells = np.column_stack([source, np.floor(xy / (_CELL_RATIO * gray.shape[1]))])[inlier]
    num_cells = len(np.unique(cells, axis=0))
    inverse: Float64 = np.linalg.pinv(matrix, hermitian=True).astype(np.float64)
    covariance: Float64 = std_px**2 * inverse
    num_inliers = int(inlier.sum())
    return FramePose((rotation, translation), covariance, num_inliers, num_inliers / num_cells)


def _track(keyframe: Keyframe, gray: UInt8, predicted: Pose) -> tuple[Float32, Float64, Float64]:
    """Track the points of a keyframe into a frame; return pixels (m, 2) and segment ends."""
    camera = keyframe.camera
    size = gray.shape[1], gray.shape[0]
    middle = transform(*predicted, (keyframe.near + keyframe.far) / 2)
    rows = np.flatnonzero(middle[:, 2] > 0)
    guess = camera.distort(project(camera.pinhole, middle[rows]))
    visible = inside(guess, size)
    rows = rows[visible]
    if not len(rows):
        return np.zeros((0, 2), np.float32), np.zeros((0, 3)), np.zeros((0, 3))
    start = keyframe.xy[rows, None] - _CENTER
    guess = guess[visible, None].astype(np.float32) - _CENTER
    there, tracked = track_points(keyframe.gray, gray, start, guess)
    good: Bool = tracked & inside(there[:, 0] + _CENTER, size)
    rows = rows[good]
    return there[good, 0] + _CENTER, keyframe.near[rows], keyframe.far[rows]


def _lift_corners(
    gray: UInt8, camera: FrameCamera, pose: Pose, depth: DepthPrior, occupied: Float64
) -> tuple[Float64, Float64, Float64]:
    """Detect corners away from other points; return pixels and ends of their ray segments."""
    width = gray.shape[1]
    distance = _MIN_DISTANCE_RATIO * width
    free = np.full(gray.shape, 255, np.uint8)
    for x, y in occupied.round().astype(int).tolist():
        cv2.circle(free, (x, y), max(1, round(distance)), 0, -1)
    count = max(1, MAX_POINTS - len(occupied))
    found = cv2.goodFeaturesToTrack(gray, count, 0.01, distance, mask=free)
    none = np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3))
    if found is None or len(occupied) >= MAX_POINTS:
        return none
    xy = found[:, 0].astype(np.float64) + _CENTER
    view = camera.undistort(xy)
    visible = inside(view, camera.pinhole.size)
    grid = depth.shape[1], depth.shape[0]
    cells = scale_pixels(view, camera.pinhole.size, grid)
    cells = np.clip(cells, 0, np.array(grid) - 1e-3)
    visible &= sample_nearest(depth.valid, cells)
    xy, view, cells = xy[visible], view[visible], cells[visible]
    if not len(xy):
        return none
    z = sample_nearest(depth.depth, cells).astype(np.float64)
    assert depth.variance is not None  # refined depth maps have a variance
    log_std = np.sqrt(sample_nearest(depth.variance, cells)) / z
    rotation, translation = pose
    ends = (
        z[:, None] * np.exp(sign * _DEPTH_DEVIATION * log_std)[:, None] * rays(camera.pinhole, view)
        for sign in (-1, 1)
    )
    near, far = ((end - translation) @ rotation for end in ends)
    return xy, near, far


def _spread(xy: Float64, width: int, count: int) -> list[int]:
    """Select at most ``count`` points of ``xy`` (n, 2), and at most one in each cell of a grid."""
    cells = np.floor(xy / (_MIN_DISTANCE_RATIO * width)).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    step = max(1.0, len(first) / count)
    chosen = first[np.unique((np.arange(min(count, len(first))) * step).astype(int))]
    return sorted(int(row) for row in chosen)
