"""Importer of sessions in the capture format of LaMAR, which CroCoDL uses, too.

The source is one session (``sessions/ID``) with the comma-separated files ``sensors.txt``
(``sensor_id, name, type, model, width, height, parameters``), ``images.txt`` and ``depths.txt``
(``timestamp, sensor_id, path`` below ``raw_data/``; depth is optional, in millimeters),
``trajectories.txt`` (``timestamp, device_id, qw, qx, qy, qz, tx, ty, tz``, ``world_from_device`` in
meters) and ``rigs.txt`` (``rig_id, sensor_id`` and ``rig_from_sensor``). Poses of
``proc/alignment_trajectories.txt``, which are relative to the scan, take precedence.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import Frame, require_path
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.geometry import compose, invert
from mpsfm_core.inputs.text_files import read_text_file

_Row = tuple[str, ...]


def read_frames(source: Path) -> list[Frame]:
    """Read the images of a session that have a true pose, in the order of ``images.txt``."""
    cameras = _read_cameras(require_path(source / "sensors.txt", "list of sensors"))
    images = _read_rows(require_path(source / "images.txt", "list of images"), 3)
    aligned = source / "proc" / "alignment_trajectories.txt"
    trajectory = aligned if aligned.is_file() else source / "trajectories.txt"
    poses = _read_poses(require_path(trajectory, "trajectory"))
    rigs = _read_poses(source / "rigs.txt") if (source / "rigs.txt").is_file() else {}
    depths = {}
    if (source / "depths.txt").is_file():
        depths = {row[:2]: row[2] for row in _read_rows(source / "depths.txt", 3)}
    frames = []
    for time, sensor, name in images:
        pose = _sensor_from_world(time, sensor, poses, rigs)
        if pose is None or sensor not in cameras:
            continue
        photo = require_path(source / "raw_data" / name, "image")
        depth = depths.get((time, sensor))
        read = None if depth is None else partial(read_depth, source / "raw_data" / depth)
        frames.append(Frame(name, photo, cameras[sensor], np.column_stack(pose), read))
    return frames


def _sensor_from_world(
    time: str, sensor: str, poses: dict[_Row, Pose], rigs: dict[_Row, Pose]
) -> Pose | None:
    """Return the pose of a sensor, from its own pose or from that of its rig."""
    own = poses.get((time, sensor))
    if own is not None:
        return own
    for (rig, member), sensor_from_rig in rigs.items():
        if member == sensor and (time, rig) in poses:
            return compose(sensor_from_rig, poses[time, rig])
    return None


def _read_cameras(path: Path) -> dict[str, pycolmap.Camera]:
    cameras = {}
    for sensor, _, kind, *values in _read_rows(path, 3):
        if kind != "camera":
            continue
        try:
            model, width, height, *parameters = values
            cameras[sensor] = pycolmap.Camera(
                model=model,
                width=int(width),
                height=int(height),
                params=[float(value) for value in parameters],
            )
        except ValueError as error:
            raise InputError(f"{path}: the camera {sensor} cannot be read: {error}") from error
    return cameras


def _read_poses(path: Path) -> dict[_Row, Pose]:
    """Read the inverse of each pose, by the first two values of its line."""
    poses: dict[_Row, Pose] = {}
    for row in _read_rows(path, 9):
        poses[row[:2]] = invert(*_pose(path, row[2:9]))
    return poses


def _pose(path: Path, values: Sequence[str]) -> tuple[Float64, Float64]:
    try:
        numbers = np.array(values, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: a pose has seven numbers: {error}") from error
    rotation = pycolmap.Rotation3d(numbers[[1, 2, 3, 0]] / np.linalg.norm(numbers[:4])).matrix()
    return rotation, numbers[4:]


def _read_rows(path: Path, count: int) -> list[_Row]:
    """Read the values of each line, of which there are at least ``count``."""
    rows = []
    for number, line in enumerate(read_text_file(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        row = tuple(value.strip() for value in line.split(","))
        if len(row) < count:
            raise InputError(f"{path}, line {number}: {len(row)} values, not {count} or more")
        rows.append(row)
    return rows
