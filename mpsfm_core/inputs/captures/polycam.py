"""Reader of captures that Polycam exports as raw data in developer mode.

The folder ``keyframes`` has images, cameras, depth maps in millimeters and confidence maps. The
name of a keyframe's files is the time of the keyframe. Poses that Polycam optimized and images that
Polycam undistorted (``corrected_*``) are preferred to the poses and images of ARKit
[PolyCam/polyform, README].
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.captures.frame import (
    HIGH,
    LOW,
    MEDIUM,
    CapturedFrame,
    CaptureFormat,
    pinhole_camera,
    pose_from_arkit,
    read_depth_png,
    read_png,
)
from mpsfm_core.inputs.image_decoding import read_bytes
from mpsfm_core.inputs.text_files import read_text_file

_KEYFRAMES = "keyframes"
_LEVELS = np.array([LOW, MEDIUM, HIGH], np.uint8)
"""Confidence level by the stored value 0, 127 or 255 divided by 86 and rounded down."""
_CAMERA_KEYS = ("fx", "fy", "cx", "cy")
_POSE_KEYS = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]


def _is_capture(path: Path) -> bool:
    return (path / _KEYFRAMES / "cameras").is_dir()


def _read_frames(path: Path) -> Iterator[CapturedFrame]:
    folder = path / _KEYFRAMES
    is_corrected = (folder / "corrected_cameras").is_dir()
    prefix = "corrected_" if is_corrected and (folder / "corrected_images").is_dir() else ""
    files = sorted((folder / f"{prefix}cameras").glob("*.json"))
    if not files:
        raise InputError(
            f"{folder}: the capture has no cameras; export the capture again as raw data"
        )
    for file in files:
        image = folder / f"{prefix}images" / f"{file.stem}.jpg"
        size, params, pose = _read_camera(file)
        try:
            cam_from_world = pose_from_arkit(pose)
        except ValueError as error:
            raise InputError(f"{file}: {error}") from error
        confidence = read_png(folder / "confidence" / f"{file.stem}.png")
        yield CapturedFrame(
            image.name,
            read_bytes(image),
            pinhole_camera(size, params, str(file)),
            cam_from_world,
            read_depth_png(folder / "depth" / f"{file.stem}.png"),
            None if confidence is None else _LEVELS[confidence // 86],
        )


def _read_camera(file: Path) -> tuple[tuple[int, int], list[float], Float64]:
    try:
        values = json.loads(read_text_file(file))
        size = int(values["width"]), int(values["height"])
        params = [float(values[key]) for key in _CAMERA_KEYS]
        pose = np.array([[float(values[key]) for key in row] for row in _POSE_KEYS])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"camera {file} of the capture cannot be read: {error!r}") from error
    return size, params, pose


POLYCAM = CaptureFormat("Polycam", _is_capture, _read_frames)
