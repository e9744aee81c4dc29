"""Reader of ``transforms.json``, the camera file of nerfstudio and instant-ngp.

Each frame has intrinsics and ``world_from_cam`` with OpenGL's camera axes (x right, y up, z
backward). The reader returns a COLMAP model without points, in the world frame of
``transforms.json``.
"""

from __future__ import annotations

import json
import math
import posixpath
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.image_decoding import EXTENSIONS, check_size, read_bytes, upright_size
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.text_files import read_text_file

DISTORTION_KEYS: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Keys of the distortion parameters in ``transforms.json`` by COLMAP camera model."""
_CAMERA_KEYS = (
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x"),
    *("k1", "k2", "k3", "k4", "p1", "p2"),
)
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Diagonal matrix that converts camera axes between OpenCV (y down, z forward) and OpenGL."""
_LARGEST = 1 << 20
"""Upper bound of image width and height in pixels."""
_ROTATION_TOLERANCE = 1e-3
"""Tolerance of the entries of ``R^T R - I`` of a rotation ``R`` that was rounded in the file."""


def read_transforms(path: Path, images_folder: Path | None = None) -> pycolmap.Reconstruction:
    """Read cameras and poses of all frames; image names are the ``file_path`` values.

    Intrinsics in ``transforms.json`` are per frame or shared by all frames. If ``transforms.json``
    has no image size, the size is read from the image file.

    Args:
        path: path of the ``transforms.json``.
        images_folder: folder of the images, if they have moved from their ``file_path``.

    Raises:
        InputError: ``transforms.json`` is damaged or a frame is invalid; the message names the
            frame.
    """
    try:
        data = json.loads(read_text_file(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: the file has no 'frames', so it is not a transforms.json")
    shared = {key: value for key, value in data.items() if key != "frames"}
    model = pycolmap.Reconstruction()
    cameras: dict[str, int] = {}
    names: set[str] = set()
    for number, frame in enumerate(frames, start=1):
        where = f"{path}, frame {number}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{where}: the frame has no 'file_path'")
        name = posixpath.normpath(frame["file_path"].replace("\\", "/"))
        where += f" ({name})"
        if name in names:
            raise InputError(f"{where}: an earlier frame of transforms.json has the same file_path")
        names.add(name)
        camera = _camera(where, {**shared, **frame}, _find_image(path.parent / name, images_folder))
        key = camera_key(camera)
        if key not in cameras:
            camera.camera_id = cameras[key] = len(cameras) + 1
            model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=cameras[key], image_id=number)
        pose = np.linalg.inv(_world_from_camera(where, frame.get("transform_matrix")))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    return model


def _world_from_camera(where: str, value: object) -> Float64:
    """Return the pose ``world_from_cam`` (4, 4) of a frame with OpenCV camera axes."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(f"{where}: 'transform_matrix' must be 4 rows of 4 numbers")
    pose = np.eye(4)
    pose[:3] = matrix[:3]
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotation.T @ rotation - np.eye(3)).max()
        scale = float(np.cbrt(abs(np.linalg.det(rotation))))
    if not off <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        advice = _explain_matrix(rotation, scale)
        raise InputError(
            f"{where}: the left 3x3 block of 'transform_matrix' is not a rotation{advice}"
        )
    left, _, right = np.linalg.svd(rotation)
    pose[:3, :3] = left @ right
    return pose @ OPENGL_FROM_OPENCV


def _explain_matrix(rotation: Float64, scale: float) -> str:
    """Describe why a matrix is not a rotation, and what the user can do."""
    if not np.isfinite(scale) or scale < 1e-12:
        return ""
    unscaled = rotation / scale
    if np.abs(unscaled.T @ unscaled - np.eye(3)).max() > _ROTATION_TOLERANCE:
        return "; its axes are scaled differently or not perpendicular: export the poses again"
    if np.linalg.det(rotation) < 0:
        return "; it is mirrored: negate the axis that the exporting program flipped"
    return (
        f" but a rotation times {scale:.6g}: the camera is scaled. In Blender apply the scale of "
        f"the camera and its parents (Ctrl+A, Scale) and export again, or divide the block by "
        f"{scale:.6g}"
    )


def _camera(where: str, values: Mapping[str, Any], picture: Path | None) -> pycolmap.Camera:
    numbers = _numbers(where, values)
    if "w" not in numbers or "h" not in numbers:
        numbers.update(_picture_size(where, picture))
    if not 1 <= min(numbers["w"], numbers["h"]) <= max(numbers["w"], numbers["h"]) < _LARGEST:
        raise InputError(
            f"{where}: image width 'w' {numbers['w']:g} or height 'h' {numbers['h']:g} is invalid"
        )
    width, height = int(numbers["w"]), int(numbers["h"])
    focal = numbers.get("fl_x")
    if focal is None and 0 < numbers.get("camera_angle_x", 0) < math.pi:
        focal = 0.5 * width / math.tan(0.5 * numbers["camera_angle_x"])
    if focal is None or min(focal, width, height) <= 0:
        raise InputError(
            f"{where}: the frame has no focal length ('fl_x' in pixels, or 'camera_angle_x')"
        )
    center = numbers.get("cx", width / 2), numbers.get("cy", height / 2)
    params = [focal, numbers.get("fl_y", focal), *center]
    k1, k2, k3, k4, p1, p2 = (numbers.get(k, 0.0) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = values.get("camera_model", "OPENCV")
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye"):
        model, params = "OPENCV_FISHEYE", [*params, k1, k2, k3, k4]
    elif model not in DISTORTION_KEYS or k4:
        what = (
            f"camera model {model}" if model not in DISTORTION_KEYS else "a fourth coefficient k4"
        )
        raise InputError(f"{where}: {what} is not supported; undistort the photos first")
    elif k3:
        model, params = "FULL_OPENCV", [*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    elif k1 or k2 or p1 or p2:
        model, params = "OPENCV", [*params, k1, k2, p1, p2]
    else:
        model = "PINHOLE"
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def _numbers(where: str, values: Mapping[str, Any]) -> dict[str, float]:
    """Return the camera parameters of a frame; raise :class:`InputError` for invalid numbers."""
    numbers = {key: values[key] for key in _CAMERA_KEYS if values.get(key) is not None}
    for name, value in numbers.items():
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise InputError(f"{where}: {name!r} must be a number, but is {value!r}")
    return numbers


def _find_image(path: Path, images_folder: Path | None) -> Path | None:
    """Find the image file of a frame, also with another extension or other leading folders."""
    candidates = [path]
    if images_folder is not None:
        parts = path.parts
        candidates += [images_folder.joinpath(*parts[i:]) for i in range(1, len(parts))]
    for candidate in candidates:
        named = (candidate.with_name(candidate.name + ending) for ending in sorted(EXTENSIONS))
        file = next((file for file in (candidate, *named) if file.is_file()), None)
        if file is not None:
            return file
    return None


def _picture_size(where: str, file: Path | None) -> dict[str, float]:
    """Return (width, height) of the image file of a frame."""
    if file is None:
        raise InputError(
            f"{where}: 'w' and 'h' are missing, and the image file does not exist; "
            f"add 'w' and 'h' to transforms.json"
        )
    data = read_bytes(file)
    check_size(data, file, InputOptions().max_pixels)
    width, height = upright_size(data, read_header(data), file)
    return {"w": width, "h": height}
