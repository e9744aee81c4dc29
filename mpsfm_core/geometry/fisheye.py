"""Projection and perspective views of wide-angle cameras, also beyond 180 degrees."""

from __future__ import annotations

import numpy as np
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.geometry.projection import inside

VIEW_HALF_ANGLE_DEG = 45.0
"""Angle between the optical axis of a view of 90 degrees and the middle of its borders."""
NUM_RING_VIEWS = 6
"""Number of views around the optical axis, so that adjacent views overlap at every angle. [ours]"""
_DEGREES = {
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": (3,),
    "RADIAL_FISHEYE": (3, 5),
    "OPENCV_FISHEYE": (3, 5, 7, 9),
    "THIN_PRISM_FISHEYE": (3, 5, 2, 2, 7, 9, 2, 2),
    "RAD_TAN_THIN_PRISM_FISHEYE": (3, 5, 7, 9, 11, 13, 2, 2, 2, 4, 2, 4),
}
"""Degree of the monomial of the viewing angle that each distortion coefficient of a COLMAP camera
model multiplies."""
_ANGLE_STEP_DEG = 0.25
_NUM_AZIMUTHS = 72


def project_wide(camera: pycolmap.Camera, directions: Float64) -> Float64:
    """Project directions to pixels, also directions behind a fisheye camera.

    COLMAP's fisheye models project directions of less than 90 degrees from the optical axis. A
    camera with doubled focal length, and with a distortion coefficient of degree ``d`` multiplied
    by ``2^(d - 1)``, projects directions with half the angle to the same pixels.

    Args:
        camera: Camera of any COLMAP model.
        directions: (m, 3) directions of any length, x right, y down, z forward.

    Returns:
        (m, 2) pixels, NaN for directions behind a camera that is not of a fisheye model.
    """
    degrees = _DEGREES.get(camera.model_name)
    if degrees is None:
        pixels: Float64 = camera.img_from_cam(directions)
        return pixels
    half = pycolmap.Camera(camera.todict())
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] *= 2
    params[list(camera.extra_params_idxs())] *= 2.0 ** (np.array(degrees, dtype=np.float64) - 1)
    half.params = params
    bisectors = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    bisectors[:, 2] += 1.0
    halved: Float64 = half.img_from_cam(bisectors)
    return halved


def find_visible_angles_deg(camera: pycolmap.Camera) -> Float64:
    """Return the largest visible angle from the optical axis at equally spaced azimuths.

    A distortion polynomial is valid up to the angle at which the distance from the principal point
    stops growing.

    Args:
        camera: Camera of any COLMAP model.

    Returns:
        (n,) angles in degrees, at azimuths from x (right) to y (down).
    """
    angles_deg = np.arange(0, 180, _ANGLE_STEP_DEG)
    angles = np.radians(angles_deg)[:, None]
    azimuths = 2 * np.pi * np.arange(_NUM_AZIMUTHS) / _NUM_AZIMUTHS
    directions = np.stack(
        [
            np.sin(angles) * np.cos(azimuths),
            np.sin(angles) * np.sin(azimuths),
            np.broadcast_to(np.cos(angles), (len(angles), _NUM_AZIMUTHS)),
        ],
        axis=-1,
    )
    pixels = project_wide(camera, directions.reshape(-1, 3)).reshape((*directions.shape[:2], 2))
    center = camera.principal_point_x, camera.principal_point_y
    radii = np.linalg.norm(pixels - center, axis=-1)
    with np.errstate(invalid="ignore"):
        is_visible = inside(pixels, (camera.width, camera.height))
        is_visible[1:] &= np.diff(radii, axis=0) > 0
    visible: Float64 = angles_deg[np.logical_and.accumulate(is_visible, axis=0).sum(axis=0) - 1]
    return visible


def measure_field_of_view_deg(camera: pycolmap.Camera) -> float:
    """Return the angle between the middles of two opposite image borders, the larger of both.

    Examples:
        >>> camera = pycolmap.Camera(
        ...     model="SIMPLE_FISHEYE", width=942, height=500, params=[300, 471, 250]
        ... )
        >>> measure_field_of_view_deg(camera)
        179.5
    """
    angles_deg = find_visible_angles_deg(camera)
    across = angles_deg + np.roll(angles_deg, _NUM_AZIMUTHS // 2)
    return float(max(across[0], across[_NUM_AZIMUTHS // 4]))


def make_fisheye_view_rotations(half_angle_deg: float) -> Float64:
    """Return the rotations (n, 3, 3) of views of 90 degrees that cover a fisheye image.

    A rotation is ``view_from_camera``. All views are level: their x axis is horizontal in the
    camera frame. The first view looks along the optical axis, and tilted views around the optical
    axis reach the border of the image.

    Args:
        half_angle_deg: Largest angle from the optical axis that the image shows, in degrees.
    """
    ring = 2 * np.pi * np.arange(NUM_RING_VIEWS) / NUM_RING_VIEWS
    tilt_deg = max(half_angle_deg - VIEW_HALF_ANGLE_DEG, 0.0)
    azimuths = np.concatenate([[0.0], ring])
    tilt = np.radians(np.concatenate([[0.0], np.full(NUM_RING_VIEWS, tilt_deg)]))
    forward = np.stack(
        [np.sin(tilt) * np.cos(azimuths), np.sin(tilt) * np.sin(azimuths), np.cos(tilt)], axis=1
    )
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
