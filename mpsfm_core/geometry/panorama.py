"""Equirectangular panoramas: perspective views, and pixels of viewing directions."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.geometry.projection import pixel_centers, rays

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


def make_view_camera(width: int) -> PinholeCamera:
    """Return the camera of a view of 90 degrees with the resolution of a panorama.

    Args:
        width: Width of the panorama in pixels.
    """
    side = max(2, round(width / np.pi))
    return PinholeCamera(side, side, side / 2, side / 2, side / 2, side / 2)


def panorama_pixels(directions: Float64, size: tuple[int, int]) -> Float64:
    """Return the pixels (..., 2) of a panorama in which viewing directions (..., 3) lie.

    Args:
        directions: Directions of any length, x right, y down, z to the middle of the panorama.
        size: (width, height) of the panorama of 360 x 180 degrees in pixels.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    longitude, latitude = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    columns = size[0] * (0.5 + longitude / (2 * np.pi))
    return np.stack([columns, size[1] * (0.5 + latitude / np.pi)], axis=-1)


def view_pixels_in_panorama(
    camera: PinholeCamera, rotation: Float64, size: tuple[int, int]
) -> Float64:
    """Return the pixel (h, w, 2) of a panorama that each pixel of a view shows.

    Args:
        camera: Camera of the view.
        rotation: (3, 3) rotation ``view_from_panorama``.
        size: (width, height) of the panorama in pixels.
    """
    directions = rays(camera, pixel_centers(camera.width, camera.height)) @ rotation
    pixels = panorama_pixels(directions, size)
    return pixels.reshape(camera.height, camera.width, 2)
