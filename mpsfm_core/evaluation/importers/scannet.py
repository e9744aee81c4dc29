"""Importer of ScanNet scenes that ScanNet's SensReader exported from a ``.sens`` file.

The importer reads ``color/N.jpg``, ``depth/N.png`` (millimeters, 0 unknown), ``pose/N.txt`` (4 x 4
``world_from_cam``, meters; not finite if tracking was lost), ``intrinsic/intrinsic_color.txt`` and
``intrinsic_depth.txt`` (4 x 4, the center of the first pixel at (0, 0)). The color and depth camera
are assumed to have the same pose, as in the published extrinsics.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import (
    Frame,
    invert_pose,
    photo_size,
    pinhole_camera,
    require_path,
    resample_depth,
)
from mpsfm_core.evaluation.prior_quality import read_depth


def read_frames(source: Path) -> list[Frame]:
    """Read the ScanNet frames that have a pose, in temporal order."""
    folder = require_path(source / "color", "folder of photos")
    intrinsic = require_path(source / "intrinsic", "folder of intrinsics")
    frames = []
    for photo in sorted(folder.glob("*.jpg"), key=lambda path: (len(path.stem), path.stem)):
        pose_file = source / "pose" / f"{photo.stem}.txt"
        depth = source / "depth" / f"{photo.stem}.png"
        if not pose_file.is_file():
            continue
        pose = np.loadtxt(pose_file)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            continue
        camera = _camera(intrinsic / "intrinsic_color.txt", photo_size(photo))
        frames.append(
            Frame(
                f"{photo.stem.zfill(6)}.jpg",
                photo,
                camera,
                invert_pose(pose),
                _depth_reader(depth, intrinsic / "intrinsic_depth.txt", camera),
            )
        )
    return frames


def _depth_reader(
    depth: Path, intrinsic: Path, photo: pycolmap.Camera
) -> Callable[[], Float32] | None:
    if not depth.is_file():
        return None
    depth_camera = _camera(intrinsic, photo_size(depth))
    return lambda: resample_depth(read_depth(depth), depth_camera, photo)


def _camera(path: Path, size: tuple[int, int]) -> pycolmap.Camera:
    matrix = np.loadtxt(require_path(path, "intrinsics"))
    if matrix.shape != (4, 4):
        raise InputError(f"{path}: the file contains no 4 x 4 matrix")
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    return pinhole_camera(size, float(fx), float(fy), float(cx), float(cy))
