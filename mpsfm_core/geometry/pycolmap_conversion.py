"""Conversion between :class:`~mpsfm_core.data.PinholeCamera` and pycolmap's cameras."""

from __future__ import annotations

import pycolmap

from mpsfm_core.data import PinholeCamera


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


def camera_key(camera: pycolmap.Camera) -> str:
    """Return a text key that is equal for cameras of equal model, size and parameters."""
    return f"{camera.model_name} {camera.width} {camera.height} {camera.params.tolist()}"
