"""Convert COLMAP models from stored pixels to upright images (after EXIF rotation).

COLMAP ignores the EXIF orientation, so that its cameras, poses and keypoints belong to stored
pixels. MP-SfM uses upright images, after EXIF rotation. The EXIF orientation maps camera
coordinates by ``x_upright = D x_stored``, where ``D`` permutes the x and y axes and flips their
signs.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.image_decoding import (
    EXTENSIONS,
    apply_orientation_to_pixels,
    decode_rgb,
    read_bytes,
    upright_size,
)
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.image_search import walk_files

_log = logging.getLogger(__name__)

MIRRORED = frozenset((2, 4, 5, 7))
"""EXIF orientations that mirror the image."""
_SWAPPED_PARAMS = (("fx", "fy"), ("cx", "cy"), ("p1", "p2"), ("sx1", "sy1"))
"""Camera parameters that a transposition of x and y swaps. The tangential distortion along x and y
is ``(p2, p1)``."""
_MAX_COMPARED_IMAGES = 5
"""Maximum number of images whose pixels are compared with the colors of the 3D points."""
_MIN_COLORED_POINTS = 20
"""Minimum number of colored 3D points of an image whose pixels are compared."""
_MAX_ASPECT_DIFFERENCE = 0.02
"""Maximum difference of log aspect ratios of a camera and its image."""


@dataclass(frozen=True)
class _ImageFile:
    """Image file of a model with its EXIF orientation and upright (width, height)."""

    path: Path
    orientation: int
    size: tuple[int, int]

    @property
    def stored_size(self) -> tuple[int, int]:
        """(width, height) of the image before EXIF rotation."""
        return stored_size(self.size, self.orientation)


def stored_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return (width, height) of an image before EXIF rotation from its upright size."""
    return size[::-1] if orientation >= 5 else size


def orientation_matrix(orientation: int) -> Float64:
    """Return the matrix ``D`` (3, 3) of ``x_upright = D x_stored`` in camera coordinates."""
    matrix = np.eye(3)
    if orientation >= 5:
        matrix = matrix[[1, 0, 2]]
    if orientation in (3, 4, 7, 8):
        matrix = np.diag([1.0, -1.0, 1.0]) @ matrix
    if orientation in (2, 3, 6, 7):
        matrix = np.diag([-1.0, 1.0, 1.0]) @ matrix
    return matrix


def orient_camera(camera: pycolmap.Camera, orientation: int) -> pycolmap.Camera:
    """Convert a camera from the stored pixels to the upright image."""
    names = [name.strip() for name in camera.params_info.split(",")]
    values = dict(zip(names, camera.params.tolist(), strict=True))
    width, height = camera.width, camera.height
    if orientation >= 5:
        width, height = height, width
        for x_name, y_name in _SWAPPED_PARAMS:
            if x_name in values and y_name in values:
                values[x_name], values[y_name] = values[y_name], values[x_name]
    if orientation in (3, 4, 7, 8):
        values["cy"] = height - values["cy"]
        values |= {name: -values[name] for name in ("p1", "sy1") if name in values}
    if orientation in (2, 3, 6, 7):
        values["cx"] = width - values["cx"]
        values |= {name: -values[name] for name in ("p2", "sx1") if name in values}
    return pycolmap.Camera(
        model=camera.model_name,
        width=width,
        height=height,
        params=[values[name] for name in names],
        camera_id=camera.camera_id,
    )


def orient_model(
    model: pycolmap.Reconstruction,
    images_folder: Path,
    match: Callable[[list[str], list[str]], dict[str, str]],
) -> pycolmap.Reconstruction:
    """Convert a COLMAP model from stored pixels to upright images if necessary.

    The pose of an image belongs to stored pixels if its camera has the size before EXIF rotation.
    If the camera size fits the image before and after EXIF rotation, the colors of the 3D points
    decide whether the pose belongs to stored pixels, else the majority of the other images. If
    neither colors nor a majority decide, the pose belongs to stored pixels [COLMAP].

    Args:
        model: COLMAP model of stored or upright images.
        images_folder: folder with the image files.
        match: function that matches file names with the image names in the model.

    Returns:
        The model of the upright images, or ``model`` itself if all are upright. If EXIF mirrors the
        images, the world is mirrored too.

    Raises:
        InputError: the EXIF orientation mirrors only some of the images.
    """
    files = _find_image_files(model, images_folder, match)
    turned = {i: f for i, f in files.items() if f.orientation != 1}
    if not turned:
        return model
    stored, ambiguous, num_upright = {}, {}, 0
    for image_id, file in turned.items():
        camera = model.cameras[model.images[image_id].camera_id]
        fits_stored = _has_aspect(camera, file.stored_size)
        fits_upright = _has_aspect(camera, file.size)
        if fits_stored and fits_upright:
            ambiguous[image_id] = file
        elif fits_stored:
            stored[image_id] = file
        else:
            num_upright += 1
    if ambiguous:
        prefers_stored = _compare_colors(model, ambiguous)
        if prefers_stored is None:
            prefers_stored = len(stored) >= num_upright
        if prefers_stored:
            stored |= ambiguous
    if not stored:
        return model
    mirrored = [file.orientation in MIRRORED for file in stored.values()]
    if any(mirrored) and (not all(mirrored) or len(stored) < model.num_reg_images()):
        raise InputError(
            f"{images_folder}: the model belongs to stored pixels, and some of its photos are "
            f"mirrored by their EXIF orientation and others are not; remove the orientation, for "
            f"example with 'exiftool -Orientation= *.jpg', or use upright photos"
        )
    _log.info("cameras and poses of %d rotated photos are turned upright", len(stored))
    world = np.diag([1.0, 1.0, -1.0]) if any(mirrored) else np.eye(3)
    return _build_model(model, {i: f.orientation for i, f in stored.items()}, world)


def _build_model(
    model: pycolmap.Reconstruction, orientations: dict[int, int], world: Float64
) -> pycolmap.Reconstruction:
    """Return a copy of the model with rotated images and a world multiplied by a reflection."""
    upright = pycolmap.Reconstruction()
    cameras: dict[str, int] = {}
    next_id = max(model.cameras, default=0) + 1
    for image in model.images.values():
        orientation = orientations.get(image.image_id, 1)
        original = model.cameras[image.camera_id]
        camera = original if orientation == 1 else orient_camera(original, orientation)
        key = f"{image.camera_id if orientation == 1 else orientation} {camera_key(camera)}"
        if key not in cameras:
            cameras[key] = image.camera_id if orientation == 1 else next_id
            next_id += orientation != 1
            described = {**camera.todict(), "camera_id": cameras[key]}
            upright.add_camera_with_trivial_rig(pycolmap.Camera(described))
        xy = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        if orientation != 1:
            size = original.width, original.height
            xy = apply_orientation_to_pixels(xy, size, orientation)
        new = pycolmap.Image(
            name=image.name, keypoints=xy, camera_id=cameras[key], image_id=image.image_id
        )
        if not image.has_pose:
            continue
        pose = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
        turn = orientation_matrix(orientation)
        pose = np.column_stack([turn @ pose[:, :3] @ world, turn @ pose[:, 3]])
        upright.add_image_with_trivial_frame(new, pycolmap.Rigid3d(pose))
    for point_id, point in sorted(model.points3D.items()):
        elements = [e for e in point.track.elements if e.image_id in upright.images]
        track = pycolmap.Track([pycolmap.TrackElement(e.image_id, e.point2D_idx) for e in elements])
        new_point = pycolmap.Point3D(xyz=world @ point.xyz, color=point.color, track=track)
        new_point.error = point.error
        upright.add_point3D_with_id(point_id, new_point)
    return upright


def _find_image_files(
    model: pycolmap.Reconstruction,
    images_folder: Path,
    match: Callable[[list[str], list[str]], dict[str, str]],
) -> dict[int, _ImageFile]:
    """Return the existing image files of a model by image id."""
    ids = {str(image.name): image.image_id for image in model.images.values()}
    names = [n for n in walk_files(images_folder) if PurePosixPath(n).suffix.lower() in EXTENSIONS]
    files = {}
    for name, model_name in match(names, list(ids)).items():
        path = images_folder / name
        try:
            data = read_bytes(path)
            header = read_header(data)
            if header.orientation != 1:
                size = upright_size(data, header, path)
                files[ids[model_name]] = _ImageFile(path, header.orientation, size)
        except InputError:
            continue  # a later stage reports the unreadable image
    return files


def _has_aspect(camera: pycolmap.Camera, size: tuple[int, int]) -> bool:
    difference = np.log(camera.width * size[1] / (camera.height * size[0]))
    return bool(abs(difference) < _MAX_ASPECT_DIFFERENCE)


def _compare_colors(model: pycolmap.Reconstruction, files: dict[int, _ImageFile]) -> bool | None:
    """Return whether point colors fit stored pixels better than upright ones, None if unclear."""
    cost_stored, cost_upright = 0.0, 0.0
    by_points = sorted(files, key=lambda i: -model.images[i].num_points3D)
    for image_id in by_points[:_MAX_COMPARED_IMAGES]:
        image, file = model.images[image_id], files[image_id]
        points = [point for point in image.points2D if point.has_point3D()]
        colors = np.array([model.points3D[p.point3D_id].color for p in points]).reshape(-1, 3)
        if len(points) < _MIN_COLORED_POINTS or not colors.any():
            continue
        data = read_bytes(file.path)
        try:
            rgb = decode_rgb(data, read_header(data), file.path).astype(np.float64)
        except InputError:
            continue
        camera = model.cameras[image.camera_id]
        size = camera.width, camera.height
        xy = np.array([point.xy for point in points], dtype=np.float64)
        turned = apply_orientation_to_pixels(xy, size, file.orientation)
        turned_size = stored_size(size, file.orientation)
        cost_upright += _color_difference(rgb, xy, size, colors)
        cost_stored += _color_difference(rgb, turned, turned_size, colors)
    if cost_stored == cost_upright:
        return None
    return cost_stored < cost_upright


def _color_difference(rgb: Float64, xy: Float64, size: tuple[int, int], colors: Float64) -> float:
    """Return the mean color difference of an image and its 3D points at their keypoints."""
    height, width = rgb.shape[:2]
    columns = np.clip((xy[:, 0] * width / size[0]).astype(int), 0, width - 1)
    rows = np.clip((xy[:, 1] * height / size[1]).astype(int), 0, height - 1)
    return float(np.abs(rgb[rows, columns] - colors).mean())
