"""Evaluation of trajectories with time stamps: ATE, RPE, windowed ATE and recall.

ATE and RPE follow evo (``evo_ape``, ``evo_rpe`` with ``--align --correct_scale``). The AUC of the
windowed ATE (WATE-AUC) follows VidMap (Pataki et al., ECCV 2026): each frame is aligned with the
true positions of a window of fixed path length around the frame, and the recall of its position
error is integrated up to 5 % of the path length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation, Slerp

from mpsfm_core.data import Float64, Int64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import TRAJECTORY
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.pose_auc import interpolated_area
from mpsfm_core.geometry import camera_center
from mpsfm_core.inputs.text_files import read_text_file

MAX_TIME_DIFFERENCE_S = 0.01
"""Maximum difference of the time stamps of an estimated and a true pose. [evo t_max_diff]"""
WINDOWS_M = (10.0, 25.0, 50.0, 100.0)
"""Path lengths of the windows of WATE-AUC, in units of the true trajectory. [VidMap]"""
MAX_ERROR_RATIO = 0.05
"""Upper limit of the position error in WATE-AUC, relative to the path length. [VidMap]"""
THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Maximum position errors in meters and rotation errors in degrees of the recall. [Aachen Day-
Night]"""
_MIN_FRAMES = 3
"""Minimum number of frames in a window that is aligned."""
_SUFFIXES = (".txt", ".tum", ".csv")


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses with ascending time stamps."""

    times: Float64
    """(n,) time stamps in seconds."""
    poses: tuple[Pose, ...]
    """Poses ``cam_from_world`` as rotation (3, 3) and translation (3,)."""

    def interpolate(self, times: Float64, max_gap_s: float) -> list[Pose | None]:
        """Interpolate poses at time stamps, linearly in position and by slerp in rotation.

        Args:
            times: (m,) time stamps in seconds.
            max_gap_s: Maximum distance of the two neighboring poses in seconds.

        Returns:
            Pose ``cam_from_world`` of each time stamp, or None where the neighboring poses are
            missing or farther apart than ``max_gap_s``.
        """
        unique = np.append(True, np.diff(self.times) > 0)
        known = self.times[unique]
        if len(known) < 2:
            return [None] * len(times)
        poses = [pose for pose, keep in zip(self.poses, unique, strict=True) if keep]
        rotations = Rotation.from_matrix([rotation.T for rotation, _ in poses])
        centers = np.array([camera_center(*pose) for pose in poses])
        after = np.clip(np.searchsorted(known, times), 1, len(known) - 1)
        usable = known[after] - known[after - 1] <= max_gap_s
        usable &= (times >= known[0]) & (times <= known[-1])
        clipped = np.clip(times, known[0], known[-1])
        turned = Slerp(known, rotations)(clipped).inv().as_matrix()
        positions = np.column_stack([np.interp(clipped, known, axis) for axis in centers.T])
        return [
            (rotation, -rotation @ position) if is_usable else None
            for rotation, position, is_usable in zip(turned, positions, usable, strict=True)
        ]


def find_trajectory(path: Path) -> Path | None:
    """Return the trajectory file of a path, or None if it is a model without trajectory."""
    if path.is_file() and path.suffix.lower() in _SUFFIXES:
        return path
    file = path / TRAJECTORY
    return file if file.is_file() else None


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory in the format of TUM RGB-D, or the ground truth of EuRoC.

    A line of TUM is ``timestamp tx ty tz qx qy qz qw`` with seconds. A line of EuRoC (``.csv``) is
    ``timestamp,tx,ty,tz,qw,qx,qy,qz,...`` with nanoseconds, and belongs to the IMU.

    Raises:
        InputError: the file cannot be read, or a line is not a pose.
    """
    is_euroc = path.suffix.lower() == ".csv"
    try:
        lines = read_text_file(path).splitlines()
    except OSError as error:
        raise InputError(f"{path}: the trajectory cannot be read: {error.strerror}") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = line.split(",") if is_euroc else line.split()
        try:
            rows.append([float(value) for value in values[:8]])
            if len(rows[-1]) < 8 or not np.isfinite(rows[-1]).all():
                raise ValueError("a pose has eight numbers")
        except ValueError as error:
            raise InputError(f"{path}, line {number}: the line is not a pose: {error}") from error
    if not rows:
        raise InputError(f"{path}: the trajectory has no poses")
    table = np.array(rows)
    if is_euroc:
        table[:, 0] *= 1e-9
        table[:, 4:] = table[:, [5, 6, 7, 4]]
    table = table[np.argsort(table[:, 0], kind="stable")]
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if (np.abs(norms - 1) > 0.01).any():
        raise InputError(f"{path}: a quaternion does not have length 1")
    poses = []
    for row in table:
        rotation = pycolmap.Rotation3d(row[4:] / np.linalg.norm(row[4:])).matrix().T
        poses.append((rotation, -rotation @ row[1:4]))
    return Trajectory(table[:, 0], tuple(poses))


def evaluate_trajectory(
    estimated: Trajectory, truth: Trajectory, num_missing: int = 0
) -> dict[str, Any]:
    """Compare a trajectory with the true trajectory, after alignment by a similarity transform.

    Args:
        estimated: Estimated poses.
        truth: True poses, possibly at a higher rate.
        num_missing: Number of frames without an estimated pose, which count as errors in recall and
            WATE-AUC.

    Returns:
        Report as plain data for JSON. Areas and recalls are percentages.

    Raises:
        InputError: fewer than three estimated poses at different positions have a true pose within
            :data:`MAX_TIME_DIFFERENCE_S`.
    """
    rows, true_rows = associate_time_stamps(estimated.times, truth.times)
    poses = {str(k): estimated.poses[row] for k, row in enumerate(rows)}
    true_poses = {str(k): truth.poses[row] for k, row in enumerate(true_rows)}
    errors = trajectory_errors(poses, true_poses)
    if errors is None:
        raise InputError(
            f"{len(rows)} of {len(estimated.times)} estimated poses have a true pose within "
            f"{MAX_TIME_DIFFERENCE_S} s, and at least three different positions are needed; check "
            f"that both trajectories have time stamps in seconds of the same clock"
        )
    centers = np.stack([camera_center(*pose) for pose in poses.values()])
    true_centers = np.stack([camera_center(*pose) for pose in true_poses.values()])
    path = np.concatenate([[0], np.linalg.norm(np.diff(true_centers, axis=0), axis=1).cumsum()])
    missing = np.full(num_missing, np.inf)

    def area(values: Float64, threshold: float) -> float:
        return 100 * interpolated_area(np.concatenate([values, missing]), threshold)

    windowed = {
        f"{window:g}": area(_windowed_errors(centers, true_centers, path, window), limit)
        for window in WINDOWS_M
        if window <= path[-1] and (limit := MAX_ERROR_RATIO * window)
    }
    windowed["full"] = area(errors.centers / path[-1], MAX_ERROR_RATIO)
    count = len(rows) + num_missing
    return {
        "poses": len(estimated.times),
        "compared": len(rows),
        "missing": num_missing,
        "path_length": float(path[-1]),
        **errors.summarize(),
        "wate_auc": windowed,
        "recall": {
            f"{meters:g} m, {degrees:g} deg": 100
            * float(((errors.centers <= meters) & (errors.rotations_deg <= degrees)).sum())
            / count
            for meters, degrees in THRESHOLDS
        },
    }


def count_frames_outside_largest(trajectory: Path) -> int:
    """Count the frames of a video that have no pose in the largest component.

    Args:
        trajectory: Trajectory file of a result folder. The table of all frames has the same name
            with the extension ``.csv``; without a table, the count is 0.
    """
    table = trajectory.with_suffix(".csv")
    if table == trajectory or not table.is_file():
        return 0
    rows = read_text_file(table).splitlines()[1:]
    return sum(row.split(",")[3] != "0" for row in rows)


def associate_time_stamps(times: Float64, true_times: Float64) -> tuple[Int64, Int64]:
    """Associate each time stamp of the shorter trajectory with the nearest of the longer one.

    Returns:
        Rows of both trajectories whose time stamps differ by at most
        :data:`MAX_TIME_DIFFERENCE_S`. [evo associate_trajectories]
    """
    if len(times) > len(true_times):
        true_rows, rows = associate_time_stamps(true_times, times)
        return rows, true_rows
    after = np.clip(np.searchsorted(true_times, times), 1, max(1, len(true_times) - 1))
    before = after - 1
    after = np.minimum(after, len(true_times) - 1)
    nearer = np.abs(true_times[before] - times) <= np.abs(true_times[after] - times)
    nearest = np.where(nearer, before, after)
    near = np.abs(true_times[nearest] - times) <= MAX_TIME_DIFFERENCE_S
    return np.flatnonzero(near), nearest[near]


def _windowed_errors(
    centers: Float64, true_centers: Float64, path: Float64, window: float
) -> Float64:
    """Compute position errors (m,) of frames, each after alignment of the window around it.

    Frames with fewer than three frames in their window are omitted.
    """
    start = np.clip(path - window / 2, 0, path[-1] - window)
    low = np.searchsorted(path, start, side="left")
    high = np.searchsorted(path, start + window, side="right")
    count = (high - low).astype(np.float64)
    a, b = centers - centers.mean(axis=0), true_centers - true_centers.mean(axis=0)

    def mean(values: Float64) -> Float64:
        zero = np.zeros_like(values[:1])
        sums = np.cumsum(np.concatenate([zero, values]), axis=0)
        shape = (-1, *(1,) * (values.ndim - 1))
        result: Float64 = (sums[high] - sums[low]) / count.reshape(shape)
        return result

    mean_a, mean_b = mean(a), mean(b)
    cross = mean(b[:, :, None] * a[:, None]) - mean_b[:, :, None] * mean_a[:, None]
    variance = mean((a**2).sum(axis=1)) - (mean_a**2).sum(axis=1)
    u, singular, vt = np.linalg.svd(cross)
    signs = np.ones((len(a), 3))
    signs[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    scale = (singular * signs).sum(axis=1) / np.maximum(variance, np.finfo(np.float64).tiny)
    turned = np.einsum("nij,nj,njk,nk->ni", u, signs, vt, a - mean_a)
    errors: Float64 = np.linalg.norm(scale[:, None] * turned + mean_b - b, axis=1)
    return errors[count >= _MIN_FRAMES]
