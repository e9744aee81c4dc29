"""Convert captures with sensor depth to images, a COLMAP model with poses, and depth files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.captures.frame import HIGH, LOW, CapturedFrame, CaptureFormat
from mpsfm_core.inputs.captures.polycam import POLYCAM
from mpsfm_core.inputs.captures.record3d import RECORD3D
from mpsfm_core.inputs.captures.stray_scanner import STRAY_SCANNER
from mpsfm_core.inputs.image_decoding import upright_size
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.support.files import replace_entries, write_file
from mpsfm_core.support.npz import write_npz

FORMATS: tuple[CaptureFormat, ...] = (POLYCAM, RECORD3D, STRAY_SCANNER)
"""Supported formats of captures, which are images with depth and poses recorded by a phone app."""
IMAGES, POSES, DEPTH = "images", "poses", "depth"
"""Names of the output folders of a converted capture."""
_MAX_DEPTH_M = 5.0
"""Maximum depth in meters of the LiDAR sensor of iPhones and iPads [Polycam documentation]."""
_STD_FLOOR_M = 0.015
"""Minimum standard deviation of sensor depth in meters [Polycam documentation]."""
_HIGH_STD, _MEDIUM_STD = 0.01, 0.03
"""Depth std relative to depth for high confidence, and for medium or unknown confidence [ours]."""


@dataclass(frozen=True)
class ConvertedCapture:
    """Output folders and number of images of a converted capture."""

    program: str
    """Name of the app that wrote the capture, such as Polycam."""
    images: Path
    """Folder of the images."""
    poses: Path
    """Folder of the COLMAP model with cameras and poses but without points."""
    depth: Path | None
    """Folder of the depth maps in meters with variance, None if the capture has no depth."""
    num_images: int
    """Number of images."""


def find_format(path: Path) -> CaptureFormat | None:
    """Return the format of a capture, or None if the path is not a capture of a known format."""
    return next((form for form in FORMATS if form.matches(path)), None)


def convert_capture(path: Path, output: Path) -> ConvertedCapture:
    """Convert a capture to the folders ``images``, ``poses`` and ``depth`` of ``output``.

    Depth with low confidence or beyond the maximum range of the sensor is invalid. The standard
    deviation of depth grows with depth and depends on the confidence.

    Args:
        path: folder of a Polycam or Stray Scanner capture, or ``.r3d`` file or folder of Record3D.
        output: folder in which the folders ``images``, ``poses`` and ``depth`` are replaced.

    Raises:
        InputError: the path is no capture, or the capture is damaged or has fewer than two images.
    """
    form = find_format(path)
    if form is None:
        known = ", ".join(known.name for known in FORMATS)
        raise InputError(f"{path} is not a capture of {known}; see the page 'inputs' of the manual")
    model = pycolmap.Reconstruction()
    cameras: dict[str, int] = {}
    num_depths = 0
    with replace_entries(output, (IMAGES, POSES, DEPTH)) as fresh:
        (fresh / POSES).mkdir()
        for number, frame in enumerate(form.read_frames(path), start=1):
            _check_size(frame, path)
            write_file(fresh / IMAGES / frame.name, frame.image)
            key = camera_key(frame.camera)
            if key not in cameras:
                frame.camera.camera_id = cameras[key] = len(cameras) + 1
                model.add_camera_with_trivial_rig(frame.camera)
            image = pycolmap.Image(name=frame.name, camera_id=cameras[key], image_id=number)
            model.add_image_with_trivial_frame(image, frame.cam_from_world)
            if frame.depth is not None:
                num_depths += 1
                _write_depth(fresh / DEPTH / f"{frame.name}.npz", frame)
        if model.num_images() < 2:
            raise InputError(f"{path}: the capture has fewer than two images with poses")
        model.write_binary(str(fresh / POSES))
    depth = output / DEPTH if num_depths else None
    return ConvertedCapture(form.name, output / IMAGES, output / POSES, depth, model.num_images())


def _check_size(frame: CapturedFrame, path: Path) -> None:
    size = upright_size(frame.image, read_header(frame.image), path / frame.name)
    if size != (frame.camera.width, frame.camera.height):
        raise InputError(
            f"{path}: image {frame.name} has {size[0]}x{size[1]} pixels, but its camera is for "
            f"{frame.camera.width}x{frame.camera.height}; export the capture again"
        )


def _write_depth(path: Path, frame: CapturedFrame) -> None:
    depth, confidence = frame.depth, frame.confidence
    assert depth is not None
    if confidence is not None and confidence.shape != depth.shape:
        size = depth.shape[::-1]
        confidence = cv2.resize(confidence, size, interpolation=cv2.INTER_NEAREST_EXACT)
    valid: Bool = np.isfinite(depth) & (depth > 0) & (depth <= _MAX_DEPTH_M)
    ratio: Float32 = np.full(depth.shape, _MEDIUM_STD, np.float32)
    if confidence is not None:
        valid &= confidence > LOW
        ratio[confidence == HIGH] = _HIGH_STD
    variance = np.maximum(ratio * np.where(valid, depth, 0), np.float32(_STD_FLOOR_M)) ** 2
    write_npz(path, depth=np.where(valid, depth, 0), variance=variance, valid=valid)
