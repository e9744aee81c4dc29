"""Reader of ARKit captures of the app Stray Scanner.

The folder of a capture has ``rgb.mp4``, ``camera_matrix.csv``, ``odometry.csv`` (``world_from_cam``
with OpenCV's camera axes), ``depth/000000.png`` in millimeters and ``confidence/000000.png``
[strayrobots/scanner, docs/format.md].
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.captures.frame import (
    HIGH,
    CapturedFrame,
    CaptureFormat,
    pinhole_camera,
    read_depth_png,
    read_png,
)
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.inputs.text_files import read_text_file
from mpsfm_core.inputs.video import choose_frames, read_frames
from mpsfm_core.support.jpeg import encode_jpeg

_VIDEO, _ODOMETRY, _MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
_INTRINSICS = ("fx", "fy", "cx", "cy")


def _is_capture(path: Path) -> bool:
    return all((path / name).is_file() for name in (_VIDEO, _ODOMETRY))


def _read_frames(path: Path) -> Iterator[CapturedFrame]:
    rows = _read_rows(path / _ODOMETRY)
    shared = _read_matrix(path / _MATRIX)
    video = path / _VIDEO
    chosen = frozenset(choose_frames(video, VideoOptions()).numbers) & rows.keys()
    for number, _, pixels in read_frames(video, chosen):
        row, where = rows[number], f"{path / _ODOMETRY}, frame {number}"
        try:
            pose = np.array([float(row[key]) for key in _POSE])
            params = [float(row[key]) for key in _INTRINSICS] if "fx" in row else shared
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{where}: the pose cannot be read: {error!r}") from error
        if params is None:
            raise InputError(f"{path / _MATRIX}: the file is missing or not a 3 x 3 matrix")
        if not 0.99 < np.linalg.norm(pose[:4]) < 1.01:
            raise InputError(f"{where}: the quaternion of the pose does not have length 1")
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:])
        confidence = read_png(path / "confidence" / f"{number:06d}.png")
        yield CapturedFrame(
            f"{number:06d}.jpg",
            encode_jpeg(pixels),
            pinhole_camera((pixels.shape[1], pixels.shape[0]), params, where),
            world_from_cam.inverse(),
            read_depth_png(path / "depth" / f"{number:06d}.png"),
            None if confidence is None else np.minimum(confidence, HIGH).astype(np.uint8),
        )


def _read_rows(path: Path) -> dict[int, dict[str, str]]:
    """Read the rows of the CSV file with camera poses, by frame number."""
    try:
        lines = csv.DictReader(read_text_file(path).splitlines(), skipinitialspace=True)
        return {int(row["frame"]): row for row in lines}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: the odometry cannot be read: {error!r}") from error


def _read_matrix(path: Path) -> list[float] | None:
    """Read fx, fy, cx, cy of the camera matrix file; return None without a valid 3 x 3 matrix."""
    try:
        matrix = np.loadtxt(read_text_file(path).splitlines(), delimiter=",")
        return [float(matrix[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2))]
    except (OSError, ValueError, IndexError):
        return None


STRAY_SCANNER = CaptureFormat("Stray Scanner", _is_capture, _read_frames)
