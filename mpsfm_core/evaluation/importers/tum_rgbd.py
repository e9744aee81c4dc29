"""Importer of sequences of the TUM RGB-D and ETH3D SLAM benchmarks.

The source is a sequence with ``rgb.txt`` and ``depth.txt`` (lines ``timestamp path``; depth is
optional), and ``groundtruth.txt`` (lines ``timestamp tx ty tz qx qy qz qw``, ``world_from_cam`` of
the color camera, meters). Depth images have 5000 units per meter and the pixels of the color
images. ETH3D SLAM has the intrinsics in ``calibration.txt`` (``fx fy cx cy``, the center of the
first pixel at (0, 0)). TUM publishes the intrinsics of its three cameras on its web page; the name
of the sequence contains the camera, for example ``freiburg1``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float32, Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import (
    Frame,
    photo_size,
    pinhole_camera,
    read_image_list,
    require_path,
)
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.trajectories import read_trajectory
from mpsfm_core.inputs.text_files import read_text_file

MAX_GAP_S = 0.1
"""Maximum distance in seconds of the true poses between which the pose of an image is interpolated.

Motion capture has 100 poses per second; larger gaps are times in which the camera was not seen."""
_MAX_DEPTH_DELAY_S = 0.02
"""Maximum time difference of a color image and its depth image. [TUM associate.py]"""
_DEPTH_SCALE = 0.2
"""Millimeters per unit of the depth images."""
_CAMERAS = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
"""Intrinsics (fx, fy, cx, cy) and OpenCV distortion (k1, k2, p1, p2, k3) of the color cameras.
[TUM RGB-D, intrinsic camera calibration]"""
_SIZE = (640, 480)
"""Width and height of the images of TUM RGB-D, to which the intrinsics belong."""


def read_frames(source: Path) -> list[Frame]:
    """Read the color images that have a true pose, in temporal order."""
    times, photos = read_image_list(require_path(source / "rgb.txt", "list of color images"))
    truth = read_trajectory(require_path(source / "groundtruth.txt", "true trajectory"))
    has_depth = (source / "depth.txt").is_file()
    depths = read_image_list(source / "depth.txt") if has_depth else None
    if not photos:
        return []
    camera = _camera(source, photo_size(source / photos[0]))  # one camera took all images
    frames = []
    for time, photo, pose in zip(times, photos, truth.interpolate(times, MAX_GAP_S), strict=True):
        if pose is None:
            continue
        depth = None if depths is None else _nearest(time, *depths)
        read = None if depth is None else partial(_read_depth, source / depth)
        frames.append(Frame(photo, source / photo, camera, np.column_stack(pose), read))
    return frames


def _nearest(time: float, times: Float64, names: list[str]) -> str | None:
    """Return the image whose time stamp is nearest, or None if it is too far away."""
    distances = np.abs(times - time)
    nearest = int(np.argmin(distances)) if len(distances) else 0
    is_near = len(distances) > 0 and distances[nearest] <= _MAX_DEPTH_DELAY_S
    return names[nearest] if is_near else None


def _camera(source: Path, size: tuple[int, int]) -> pycolmap.Camera:
    file = source / "calibration.txt"
    if file.is_file():
        values = [float(value) for value in read_text_file(file).split()]
        if len(values) != 4:
            raise InputError(f"{file}: expected the four values fx fy cx cy")
        fx, fy, cx, cy = values
        return pinhole_camera(size, fx, fy, cx + 0.5, cy + 0.5)
    name = next((name for name in _CAMERAS if name in source.resolve().name), None)
    if name is None or size != _SIZE:
        raise InputError(
            f"{source}: the camera is unknown; name the folder of the original images as TUM does "
            f"(freiburg1, freiburg2 or freiburg3), or write fx fy cx cy to {file.name}"
        )
    (fx, fy, cx, cy), (k1, k2, p1, p2, k3) = _CAMERAS[name]
    params = [fx, fy, cx + 0.5, cy + 0.5, k1, k2, p1, p2, k3, 0, 0, 0]
    if not any(params[4:]):
        return pinhole_camera(size, *params[:4])
    return pycolmap.Camera(model="FULL_OPENCV", width=size[0], height=size[1], params=params)


def _read_depth(path: Path) -> Float32:
    return np.asarray(read_depth(path) * np.float32(_DEPTH_SCALE))
