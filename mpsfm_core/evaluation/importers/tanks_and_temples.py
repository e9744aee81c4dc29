"""Importer of scenes of the Tanks and Temples benchmark.

The source is a folder with the images, or with the images in ``images/``. The ground truth is a
COLMAP model in ``sparse/0``, whose points determine image overlap as in the paper, or the
trajectory log ``NAME_COLMAP_SfM.log``. The trajectory log has a line of three numbers and the 4 x 4
matrix ``world_from_cam`` for each image in the order of names. The trajectory log has no
intrinsics, so the importer assumes a typical focal length; a COLMAP model is more accurate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.colmap_model import model_frames
from mpsfm_core.evaluation.importers.frames import (
    PHOTOS,
    Frame,
    invert_pose,
    photo_size,
    pinhole_camera,
)
from mpsfm_core.evaluation.importers.smerf import has_model

_FOCAL_RATIO = 1165.72 / 1920
"""Assumed focal length relative to the image width, for scenes without a COLMAP model."""
_LINES = 5
"""Number of lines of a pose in the trajectory log."""


def read_frames(source: Path) -> list[Frame]:
    """Read the frames of a Tanks and Temples scene."""
    folder = source / "images" if (source / "images").is_dir() else source
    if has_model(source / "sparse" / "0"):
        return model_frames(source / "sparse" / "0", lambda name: folder / name)
    logs = sorted(source.glob("*_COLMAP_SfM.log"))
    if len(logs) != 1:
        raise InputError(f"{source}: sparse/0 or one *_COLMAP_SfM.log is needed")
    photos = sorted(path for path in folder.iterdir() if path.suffix.lower() in PHOTOS)
    poses = _read_log(logs[0])
    if len(photos) != len(poses):
        raise InputError(f"{logs[0]} has {len(poses)} poses, {folder} has {len(photos)} photos")
    frames = []
    for photo, pose in zip(photos, poses, strict=True):
        width, height = photo_size(photo)
        focal = _FOCAL_RATIO * width
        camera = pinhole_camera((width, height), focal, focal, width / 2, height / 2)
        frames.append(Frame(photo.name, photo, camera, invert_pose(pose)))
    return frames


def _read_log(path: Path) -> list[Float64]:
    """Read ``world_from_cam`` (4, 4) of each image from a trajectory log."""
    lines = path.read_text(encoding="utf-8").split("\n")
    lines = [line for line in lines if line.strip()]
    try:
        matrices = [
            np.array([line.split() for line in lines[start + 1 : start + _LINES]], dtype=np.float64)
            for start in range(0, len(lines), _LINES)
        ]
    except ValueError as error:
        raise InputError(f"{path}: not a trajectory: {error}") from error
    if any(matrix.shape != (4, 4) for matrix in matrices):
        raise InputError(f"{path}: not a trajectory: a pose has no 4 x 4 matrix")
    return matrices
