"""ETH3D, high-resolution multi-view, undistorted DSLR photos.

Reads a scene folder with ``dslr_calibration_undistorted/{cameras,images,points3D}.txt``,
``images/dslr_images_undistorted/*.JPG`` and, for depth, ``ground_truth_depth/dslr_images/*.JPG``
with ``dslr_calibration_jpg/``. Those depth files are no JPEGs: 4-byte floats, row by row, of the
original distorted photos, infinite where the scanner saw nothing.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.colmap_model import model_frames
from mpsfm_core.evaluation.importers.frames import Frame, carried_depth, need
from mpsfm_core.inputs.models import read_model


def read_frames(source: Path) -> list[Frame]:
    """Frames of one scene; with depth where the scan's is there."""
    calibration = need(source / "dslr_calibration_undistorted", "calibration")
    frames = model_frames(calibration, lambda name: source / "images" / name)
    depth, original = source / "ground_truth_depth" / "dslr_images", source / "dslr_calibration_jpg"
    if not depth.is_dir():
        return frames
    model = read_model(need(original, "calibration of the depth maps"))
    distorted = {Path(str(image.name)).name: image.camera for image in model.images.values()}
    return [_with_depth(frame, depth / frame.name, distorted.get(frame.name)) for frame in frames]


def _with_depth(frame: Frame, file: Path, camera: pycolmap.Camera | None) -> Frame:
    if camera is None or not file.is_file():
        return frame
    own = pycolmap.Camera(camera.todict())
    return replace(frame, depth=lambda: carried_depth(_read(file, own), own, frame.camera))


def _read(file: Path, camera: pycolmap.Camera) -> Float32:
    values = np.fromfile(file, dtype="<f4")
    if values.size != camera.width * camera.height:
        raise InputError(
            f"{file} has {values.size} values, not those of {camera.width} x {camera.height} pixels"
        )
    depth: Float32 = np.where(np.isfinite(values), values, 0).astype(np.float32)
    return depth.reshape(camera.height, camera.width)
