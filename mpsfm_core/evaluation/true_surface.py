"""The true surface, as far as the photos of a reconstruction show it: true depth as a scan."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from mpsfm_core.data import Float64, PinholeCamera, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.cloud_accuracy import thin_points
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.geometry import camera_center, pixel_centers, unproject


def true_depth_file(folder: Path, image: str) -> Path:
    """Where the true depth of an image is: named as the photo, with ``.png``."""
    return folder / PurePosixPath(image).with_suffix(".png")


def build_true_surface(
    folder: Path,
    images: Collection[str],
    cameras: Mapping[str, PinholeCamera],
    poses: Mapping[str, Pose],
    spacing: float,
) -> Float64:
    """World points (n, 3) of the true maps in ``folder`` (16-bit PNG, millimetres) of some images.

    ``cameras``: undistorted, any size, and ``poses``: true ones, by name. ``spacing``: metres, of
    the cubes of each map that keep one point. Images without map, camera or pose add nothing;
    raises :class:`InputError` when none has them all.
    """
    parts = []
    for name in images:
        file = true_depth_file(folder, name)
        if name not in poses or name not in cameras or not file.is_file():
            continue
        depth = read_depth(file)
        height, width = depth.shape
        known = depth > 0
        camera = cameras[name].resized(width, height)
        local = unproject(camera, pixel_centers(width, height)[known], depth[known])
        rotation, translation = poses[name]
        parts.append(thin_points(local @ rotation + camera_center(rotation, translation), spacing))
    if not sum(map(len, parts)):
        raise InputError(f"{folder}: has no true depth of an image with a true pose")
    return np.concatenate(parts)
