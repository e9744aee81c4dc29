"""Write the camera poses of all frames of a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.result_layout import FRAME_TABLE, TRAJECTORIES, TRAJECTORY
from mpsfm_core.geometry import camera_center

_COLUMNS = "frame,timestamp_s,source,component,num_inliers,position_std,rotation_std_deg,reason"


@dataclass(frozen=True, eq=False)
class TrajectoryFrame:
    """Frame of a video with its pose, or with the reason why it has no pose."""

    number: int
    """Number of the frame in the video, from 0."""
    time_s: float
    """Time stamp in seconds."""
    source: str
    """``keyframe``, ``tracked``, ``interpolated``, or ``none`` without a pose."""
    component: int = 0
    """Component of the reconstruction with the pose, 0 for the largest."""
    pose: Pose | None = None
    """``cam_from_world``, or None."""
    covariance: Float64 | None = None
    """(6, 6) covariance of rotation vector and camera center in the world frame, in radians and
    units of the model, relative to the keyframes."""
    num_inliers: int = 0
    """Number of tracked points that fit the pose."""
    reason: Reason | None = None
    """Reason (``FrameReason``) why the frame has no measured pose."""


def trajectory_files(folder: Path, video: str = "") -> tuple[Path, Path]:
    """Return the paths of the trajectory and of the table of frames of a video.

    Args:
        folder: Result folder.
        video: Name of the video, which is empty for a single video.
    """
    if not video:
        return folder / TRAJECTORY, folder / FRAME_TABLE
    return folder / TRAJECTORIES / f"{video}.txt", folder / TRAJECTORIES / f"{video}.csv"


def write_trajectory(folder: Path, frames: Sequence[TrajectoryFrame], video: str = "") -> None:
    """Write the poses of the largest component, and a table of all frames.

    Args:
        folder: Result folder.
        frames: All localized frames, and all frames without a pose, ascending by number.
        video: Name of the video, which is empty for a single video.
    """
    trajectory, table = trajectory_files(folder, video)
    trajectory.parent.mkdir(parents=True, exist_ok=True)
    lines = ["# timestamp tx ty tz qx qy qz qw (camera to world)"]
    for frame in frames:
        if frame.component == 0 and frame.pose is not None:
            values = *camera_center(*frame.pose), *_quaternion(frame.pose)
            lines.append(" ".join([f"{frame.time_s:.6f}", *(f"{value:.9g}" for value in values)]))
    trajectory.write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = [",".join(map(str, _row(frame))) for frame in frames]
    table.write_text("\n".join([_COLUMNS, *rows]) + "\n", encoding="utf-8")


def find_trajectories(folder: Path) -> dict[str, Path]:
    """Find the trajectory of each video by its name, which is empty for a single video."""
    single, several = folder / TRAJECTORY, folder / TRAJECTORIES
    found = {"": single} if single.is_file() else {}
    for path in sorted(several.rglob("*.txt")):
        found[path.relative_to(several).with_suffix("").as_posix()] = path
    return found


def read_trajectory_rows(path: Path) -> Float64:
    """Read the poses of a trajectory file.

    Returns:
        (n, 8) float64 time stamps, camera centers, and quaternions x, y, z, w of the camera.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line of the file is not a pose.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


def describe_trajectory(frames: Sequence[TrajectoryFrame], video: str = "") -> dict[str, Any]:
    """Describe the frames of a video for ``summary.json``."""
    sources = [frame.source for frame in frames]
    codes = [f.reason.code.value for f in frames if f.reason is not None and f.pose is None]
    return {
        "file": trajectory_files(Path(), video)[0].as_posix(),
        "frames": len(frames),
        "sources": {source: sources.count(source) for source in dict.fromkeys(sources)},
        "reasons": {code: codes.count(code) for code in dict.fromkeys(codes)},
    }


def _row(frame: TrajectoryFrame) -> list[str | int]:
    position, rotation = "", ""
    if frame.covariance is not None:
        variances = np.diag(frame.covariance)
        position = f"{np.sqrt(variances[3:].sum()):.6g}"
        rotation = f"{np.degrees(np.sqrt(variances[:3].sum())):.6g}"
    reason = "" if frame.reason is None else str(frame.reason.code.value)
    component = "" if frame.pose is None else frame.component
    time = f"{frame.time_s:.6f}"
    return [
        *(frame.number, time, frame.source, component, frame.num_inliers),
        *(position, rotation, reason),
    ]


def _quaternion(pose: Pose) -> Float64:
    """Return the quaternion x, y, z, w of ``world_from_cam``."""
    return np.asarray(pycolmap.Rotation3d(np.ascontiguousarray(pose[0].T)).quat)
