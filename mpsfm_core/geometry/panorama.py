"""Equirectangular panoramas: cameras of panoramas and of their perspective views."""

from __future__ import annotations

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, PinholeCamera

NUM_VIEWS = 8
"""Number of perspective views of a panorama, 45 degrees apart, so that adjacent views overlap by
half. [ours]"""


def make_view_rotations(count: int = NUM_VIEWS) -> Float64:
    """Return the rotations (n, 3, 3) of views around the vertical axis of a panorama.

    A rotation is ``view_from_panorama``. The first view looks at the middle of the panorama, and
    the next views look further to the right.
    """
    yaw = 2 * np.pi * np.arange(count) / count
    rotations = np.zeros((count, 3, 3))
    rotations[:, 0, 0] = rotations[:, 2, 2] = np.cos(yaw)
    rotations[:, 2, 0], rotations[:, 0, 2] = np.sin(yaw), -np.sin(yaw)
    rotations[:, 1, 1] = 1.0
    return rotations


def make_panorama_camera(width: int, height: int) -> pycolmap.Camera:
    """Return COLMAP's camera of a panorama of 360 x 180 degrees.

    Its directions have x right, y down, and z to the middle of the panorama.
    """
    return pycolmap.Camera(
        model="EQUIRECTANGULAR", width=width, height=height, params=[width, height]
    )


def make_view_camera(width: float) -> PinholeCamera:
    """Return the camera of a view of 90 degrees with the resolution of a panorama.

    Args:
        width: Width of the panorama, or number of pixels on 360 degrees of another image.
    """
    side = max(2, round(width / np.pi))
    return PinholeCamera(side, side, side / 2, side / 2, side / 2, side / 2)
