"""Importer of ETH3D: high-resolution multi-view, undistorted DSLR images.

The source is a scene folder with ``dslr_calibration_undistorted/{cameras,images,points3D}.txt``,
``images/dslr_images_undistorted/*.JPG`` and, for depth, ``ground_truth_depth/dslr_images/*.JPG``
with ``dslr_calibration_jpg/``. The ETH3D depth files contain row-major 4-byte floats of the
distorted images, infinite where unknown, despite the suffix.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.colmap_model import model_frames
from mpsfm_core.evaluation.importers.frames import Frame, require_path, resample_depth
from mpsfm_core.inputs.models import read_model


def read_frames(source: Path) -> list[Frame]:
    """Read the frames of an ETH3D scene, with depth if available."""
    calibration = require_path(source / "dslr_calibration_undistorted", "calibration")
    frames = model_frames(calibration, lambda name: source / "images" / name)
    depth, original = source / "ground_truth_depth" / "dslr_images", source / "dslr_calibration_jpg"
    if not depth.is_dir():
        return frames
    model = read_model(require_path(original, "calibration of the depth maps"))
    distorted = {Path(str(image.name)).name: image.camera for image in model.images.values()}
    return [_with_depth(frame, depth / frame.name, distorted.get(frame.name)) for frame in frames]


def _with_depth(frame: Frame, file: Path, camera: pycolmap.Camera | None) -> Frame:
    if camera is None or not file.is_file():
        return frame
    depth_camera = pycolmap.Camera(camera.todict())

    def read() -> Float32:
        return resample_depth(_read(file, depth_camera), depth_camera, frame.camera)

    return replace(frame, depth=read)


def _read(file: Path, camera: pycolmap.Camera) -> Float32:
    values = np.fromfile(file, dtype="<f4")
    if values.size != camera.width * camera.height:
        raise InputError(
            f"{file} has {values.size} values, not those of {camera.width} x {camera.height} pixels"
        )
    depth: Float32 = np.where(np.isfinite(values), values, 0).astype(np.float32)
    return depth.reshape(camera.height, camera.width)
