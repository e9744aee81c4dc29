"""True surface of a scene, sampled from the true depth maps of some images."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from mpsfm_core.data import Float32, Float64, PinholeCamera, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.cloud_accuracy import thin_points
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.geometry import camera_center, pixel_centers, unproject
from mpsfm_core.inputs.image_decoding import find_map_orientation, orient, read_bytes
from mpsfm_core.inputs.image_header import read_header


def true_depth_file(folder: Path, image: str) -> Path:
    """Return the path of an image's true depth map, the image name with suffix ``.png``."""
    return folder / PurePosixPath(image).with_suffix(".png")


def read_true_depth(
    folder: Path, image: str, size: tuple[int, int], photos: Path | None
) -> Float32 | None:
    """Read the true depth map of an image, rotated upright if the photo is EXIF-rotated.

    Args:
        folder: Folder of true depth maps as 16-bit PNG files in millimeters.
        image: Name of the photo.
        size: Upright (width, height) of the image at any resolution.
        photos: Folder of the photos with their EXIF orientation, or None if the depth maps are
            upright.

    Returns:
        Depth (h, w) in meters, 0 where unknown, or None if there is no depth map of the image.
    """
    file = true_depth_file(folder, image)
    if not file.is_file():
        return None
    depth = read_depth(file)
    if photos is None or not (photos / image).is_file():
        return depth
    orientation = read_header(read_bytes(photos / image)).orientation
    map_size = depth.shape[1], depth.shape[0]
    return orient(depth, find_map_orientation(map_size, size, orientation, "auto"))


def build_true_surface(
    folder: Path,
    images: Collection[str],
    cameras: Mapping[str, PinholeCamera],
    poses: Mapping[str, Pose],
    spacing: float,
    photos: Path | None = None,
) -> Float64:
    """Build a point cloud from the true depth maps of images with depth, camera and pose.

    Args:
        folder: Folder of true depth maps as 16-bit PNG files in millimeters.
        images: Names of the images whose true depth maps are used.
        cameras: Undistorted cameras, at any image size, by image name.
        poses: True poses ``cam_from_world`` by image name.
        spacing: Side in meters of grid cubes; each depth map contributes at most one point per
            cube.
        photos: Folder of the photos, which may be EXIF-rotated.

    Returns:
        Points (n, 3) of the true surface, world frame.

    Raises:
        InputError: No image has a true depth map, a camera and a pose.
    """
    parts = []
    for name in images:
        if name not in poses or name not in cameras:
            continue
        depth = read_true_depth(folder, name, cameras[name].size, photos)
        if depth is None:
            continue
        height, width = depth.shape
        known = depth > 0
        camera = cameras[name].resized(width, height)
        local = unproject(camera, pixel_centers(width, height)[known], depth[known])
        rotation, translation = poses[name]
        parts.append(thin_points(local @ rotation + camera_center(rotation, translation), spacing))
    if not sum(map(len, parts)):
        raise InputError(f"{folder}: no image with a true pose has a true depth map")
    return np.concatenate(parts)
