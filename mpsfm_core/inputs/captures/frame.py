"""Frame of a phone capture with sensor depth, the common type of all capture readers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.data import Float32, Float64, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_decoding import decode_stored, read_bytes

LOW, MEDIUM, HIGH = 0, 1, 2
"""Confidence levels of sensor depth [ARKit ARConfidenceLevel]."""
_MM_PER_M = 1000


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """Image of a capture with camera, pose and sensor depth."""

    name: str
    """File name of the image."""
    image: bytes
    """Bytes of the image file."""
    camera: pycolmap.Camera
    """Camera of the image."""
    cam_from_world: pycolmap.Rigid3d
    """Pose of the camera in meters; the y axis of the world points up [ARKit gravity alignment]."""
    depth: Float32 | None = None
    """Depth map (h, w) along z in meters, None if the capture has no depth of the frame."""
    confidence: UInt8 | None = None
    """Confidence map (h, w) of depth with values ``LOW`` to ``HIGH``, None if unknown."""


@dataclass(frozen=True)
class CaptureFormat:
    """Capture format of a phone app, with functions that recognize and read a capture."""

    name: str
    """Name of the app that writes captures of the format."""
    matches: Callable[[Path], bool]
    """Function that returns whether a folder or file is a capture of the format."""
    read_frames: Callable[[Path], Iterator[CapturedFrame]]
    """Function that yields the frames of a capture, and raises InputError if files are damaged."""


def pose_from_arkit(world_from_cam: Float64) -> pycolmap.Rigid3d:
    """Convert a pose of ARKit (camera x right, y up, z backward) to ``cam_from_world``.

    Args:
        world_from_cam: (3, 4) pose matrix with the position in meters.

    Raises:
        ValueError: the matrix ``world_from_cam`` is not a rigid transform.
    """
    rotation = world_from_cam[:, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not (error < 1e-3 and np.linalg.det(rotation) > 0 and np.isfinite(world_from_cam).all()):
        raise ValueError("the pose is not a rotation and a position")
    turned = pycolmap.Rotation3d(rotation * np.array([1.0, -1.0, -1.0]))
    return pycolmap.Rigid3d(turned, world_from_cam[:, 3]).inverse()


def pinhole_camera(size: tuple[int, int], params: list[float], where: str) -> pycolmap.Camera:
    """Return a PINHOLE camera; raise :class:`InputError` for invalid parameters.

    Args:
        size: (width, height) of the image in pixels.
        params: intrinsics fx, fy, cx, cy in pixels.
        where: name of the file with the intrinsics, for the error message.
    """
    camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=params)
    if not (min(size) > 0 and np.isfinite(params).all() and min(params[:2]) > 0):
        raise InputError(f"{where}: focal length {params[:2]} or image size {size} is invalid")
    return camera


def read_png(path: Path) -> NDArray[Any] | None:
    """Read a PNG file with one channel, such as a depth map; return None without such a file.

    Raises:
        InputError: the PNG file is damaged or has several channels.
    """
    if not path.is_file():
        return None
    pixels = decode_stored(read_bytes(path), path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 2:
        raise InputError(f"{path} has {pixels.shape[2]} channels instead of one")
    return pixels


def read_depth_png(path: Path) -> Float32 | None:
    """Read a PNG depth map in millimeters, and return it in meters, or None without a file."""
    millimeters = read_png(path)
    return None if millimeters is None else millimeters.astype(np.float32) / np.float32(_MM_PER_M)
