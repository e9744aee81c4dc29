"""Conversion of cameras and poses between pycolmap and MP-SfM."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import PinholeCamera, Pose
from mpsfm_core.data.errors import InputError


def colmap_from_pinhole(camera: PinholeCamera) -> pycolmap.Camera:
    """Convert a pinhole camera to a COLMAP camera of model PINHOLE."""
    return pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=camera.params
    )


def pinhole_from_colmap(camera: pycolmap.Camera) -> PinholeCamera:
    """Convert a COLMAP camera to a pinhole camera; the distortion is ignored."""
    idxs = camera.focal_length_idxs()
    params = camera.params
    return PinholeCamera(
        camera.width,
        camera.height,
        float(params[idxs[0]]),
        float(params[idxs[-1]]),
        float(camera.principal_point_x),
        float(camera.principal_point_y),
    )


def pose_from(name: str, given: Any) -> Pose:
    """Return rotation (3, 3) and translation (3,) of a pose.

    Args:
        name: Name of the image, for error messages.
        given: ``pycolmap.Rigid3d``, a (3, 4) or (4, 4) matrix, or a tuple of rotation and
            translation.

    Raises:
        InputError: the pose matrix is neither (3, 4) nor (4, 4).
    """
    if isinstance(given, tuple):
        rotation, translation = given
    else:
        matrix = np.asarray(given.matrix() if isinstance(given, pycolmap.Rigid3d) else given)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise InputError(f"pose of {name!r}: expected shape (3, 4), got {matrix.shape}")
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    return np.array(rotation, np.float64), np.array(translation, np.float64)


def camera_key(camera: pycolmap.Camera) -> str:
    """Return a string that is equal for cameras of equal model, image size and parameters."""
    return f"{camera.model_name} {camera.width} {camera.height} {camera.params.tolist()}"
