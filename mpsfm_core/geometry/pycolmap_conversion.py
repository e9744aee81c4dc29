"""Conversion between :class:`~mpsfm_core.data.PinholeCamera` and pycolmap's cameras."""

from __future__ import annotations

import pycolmap

from mpsfm_core.data import PinholeCamera


def colmap_from_pinhole(camera: PinholeCamera) -> pycolmap.Camera:
    """Return the PINHOLE camera of COLMAP with the same size and intrinsics."""
    return pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=camera.params
    )


def pinhole_from_colmap(camera: pycolmap.Camera) -> PinholeCamera:
    """Return size, focal lengths and principal point of a COLMAP camera; drops its distortion."""
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
    """Return a text that is equal for cameras of equal model, size and parameters."""
    return f"{camera.model_name} {camera.width} {camera.height} {camera.params.tolist()}"
