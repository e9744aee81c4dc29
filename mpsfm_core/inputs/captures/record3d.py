"""Reader of Record3D captures: the file ``.r3d`` (a ZIP archive) or its unpacked folder.

The file ``metadata`` has intrinsics, sizes and poses. The folder ``rgbd`` has the frames
``N.jpg``, ``N.depth`` (float32 meters) and ``N.conf`` (uint8), both compressed with LZFSE
[marek-simonik/record3d, issue 7].
"""

from __future__ import annotations

import importlib
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.captures.frame import (
    HIGH,
    CapturedFrame,
    CaptureFormat,
    pinhole_camera,
    pose_from_arkit,
)

_METADATA = "metadata"
_MAX_BYTES = 256 << 20
"""Maximum size in bytes of a file in the archive after decompression."""
_NUM_POSE_VALUES = 7
"""Number of values of a pose, a quaternion x, y, z, w and a position x, y, z."""

_Read = Callable[[str], bytes | None]
"""Function that returns the content of a file of the capture by name, None without such a file."""


def _is_capture(path: Path) -> bool:
    if path.is_dir():
        return (path / _METADATA).is_file() and (path / "rgbd").is_dir()
    return path.suffix.lower() == ".r3d" and path.is_file()


def _read_frames(path: Path) -> Iterator[CapturedFrame]:
    if path.is_dir():
        yield from _frames(path, lambda name: _read_file(path / name))
        return
    try:
        with zipfile.ZipFile(path) as archive:
            yield from _frames(path, lambda name: _read_member(archive, name))
    except (zipfile.BadZipFile, NotImplementedError, OSError) as error:
        raise InputError(f"{path}: the Record3D file is damaged: {error}") from error


def _read_file(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _read_member(archive: zipfile.ZipFile, name: str) -> bytes | None:
    try:
        member = archive.getinfo(name)
    except KeyError:
        return None
    if member.file_size > _MAX_BYTES:
        raise OSError(f"{name} has {member.file_size / 1e6:.0f} MB")
    return archive.read(member)


def _frames(path: Path, read: _Read) -> Iterator[CapturedFrame]:
    try:
        metadata = json.loads(read(_METADATA) or b"")
        size = int(metadata["w"]), int(metadata["h"])
        depth_size = int(metadata.get("dw", 0)), int(metadata.get("dh", 0))
        matrix = np.array(metadata["K"], dtype=np.float64).reshape(3, 3).T
        poses = np.array(metadata["poses"], dtype=np.float64).reshape(-1, _NUM_POSE_VALUES)
        params = _read_intrinsics(metadata, matrix, len(poses))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: the Record3D metadata cannot be read: {error!r}") from error
    if not poses[:, 4:].any():
        raise InputError(
            f"{path}: the capture has no poses, because only videos of the LiDAR camera have "
            f"poses; reconstruct the folder of its images without poses"
        )
    for number, (pose, frame_params) in enumerate(zip(poses, params, strict=True)):
        image = read(f"rgbd/{number}.jpg")
        if image is None:
            continue
        where = f"{path}, frame {number}"
        depth = _decompress(read(f"rgbd/{number}.depth"), np.float32, size, depth_size, where)
        confidence = _decompress(read(f"rgbd/{number}.conf"), np.uint8, size, depth_size, where)
        yield CapturedFrame(
            f"{number:06d}.jpg",
            image,
            pinhole_camera(size, frame_params, where),
            _convert_pose(pose, where),
            depth,
            None if confidence is None else np.minimum(confidence, HIGH),
        )


def _read_intrinsics(metadata: dict[str, Any], matrix: Float64, count: int) -> list[list[float]]:
    """Return fx, fy, cx, cy in pixels of each frame; older captures have one set for all frames."""
    shared = [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]
    frames = metadata.get("perFrameIntrinsicCoeffs") or [shared] * count
    return [[float(value) for value in params[:4]] for params in frames]


def _convert_pose(pose: Float64, where: str) -> pycolmap.Rigid3d:
    norm = np.linalg.norm(pose[:4])
    if not 0.99 < norm < 1.01:
        raise InputError(f"{where}: the quaternion of the pose has length {norm:.3g} instead of 1")
    rotation = pycolmap.Rotation3d(pose[:4] / norm).matrix()
    return pose_from_arkit(np.column_stack([rotation, pose[4:]]))


def _decompress(
    data: bytes | None, dtype: type, size: tuple[int, int], depth_size: tuple[int, int], where: str
) -> NDArray[Any] | None:
    """Decompress a depth or confidence map with LZFSE, and return an array (h, w)."""
    if data is None:
        return None
    try:
        decode = importlib.import_module("imagecodecs").lzfse_decode
    except ImportError as error:
        raise InputError(
            f"{where}: reading depth of Record3D needs imagecodecs: "
            f"pip install 'mpsfm-core[record3d]'"
        ) from error
    try:
        values: NDArray[Any] = np.frombuffer(decode(data), dtype=dtype)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{where}: the depth is damaged: {error}") from error
    width, height = depth_size if min(depth_size) > 0 else _infer_size(len(values), size)
    if len(values) != width * height:
        raise InputError(f"{where}: the depth map has {len(values)} values, not {width} x {height}")
    return values.reshape(height, width)


def _infer_size(count: int, size: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) of a depth map with ``count`` values and the image's aspect ratio."""
    width = round(float(np.sqrt(count * size[0] / size[1])))
    return width, count // max(width, 1)


RECORD3D = CaptureFormat("Record3D", _is_capture, _read_frames)
