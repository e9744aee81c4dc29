"""Frames of imported datasets, and conversion of frames to a scene folder."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.prior_quality import write_depth
from mpsfm_core.geometry import inside, pixel_centers, sample_nearest
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.text_files import read_text_file

PHOTOS = (".jpg", ".jpeg", ".png")
"""Suffixes of image files that importers accept."""
_MAX_DEPTH_COLUMNS = 1024
"""Maximum number of columns of a depth map that is resampled to another camera."""


@dataclass(frozen=True, eq=False)
class FrameObservations:
    """Observations of 3D points in an image."""

    xy: Float64
    """(p, 2) positions of the observations in COLMAP pixels of the image."""
    ids: Int64
    """(p,) ids of the observed 3D points."""
    points: Float64
    """(p, 3) coordinates of the observed 3D points, world frame."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Image with its true camera, pose and optional depth."""

    name: str
    """Name of the image in the scene folder."""
    photo: Path
    """File path of the source image."""
    camera: pycolmap.Camera
    """COLMAP camera of the image."""
    pose: Float64
    """(3, 4) true pose ``cam_from_world``."""
    depth: Callable[[], Float32] | None = None
    """Function that reads the true depth map in meters, 0 where unknown, on a grid over the whole
    image."""
    observations: FrameObservations | None = None
    """Observations of 3D points, if the dataset has points."""


def write_frames(target: Path, frames: Sequence[Frame]) -> None:
    """Write images, cameras, poses, points and depth as a scene folder."""
    model = pycolmap.Reconstruction()
    cameras: dict[str, int] = {}
    tracks: dict[int, list[tuple[int, int]]] = {}
    coordinates: dict[int, Float64] = {}
    for number, frame in enumerate(frames, start=1):
        photo = target / "images" / frame.name
        photo.parent.mkdir(parents=True, exist_ok=True)
        _link(frame.photo, photo)
        if frame.depth is not None:
            write_depth((target / "gt_depth" / frame.name).with_suffix(".png"), frame.depth())
        key = camera_key(frame.camera)
        if key not in cameras:
            cameras[key] = len(cameras) + 1
            camera = pycolmap.Camera({**frame.camera.todict(), "camera_id": cameras[key]})
            model.add_camera_with_trivial_rig(camera)
        seen = frame.observations
        xy = np.empty((0, 2)) if seen is None else seen.xy
        image = pycolmap.Image(
            name=frame.name, keypoints=xy, camera_id=cameras[key], image_id=number
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(frame.pose))
        if seen is not None:
            for row, point in enumerate(seen.ids.tolist()):
                tracks.setdefault(point, []).append((number, row))
                coordinates[point] = seen.points[row]
    for point, track in tracks.items():
        elements = [pycolmap.TrackElement(image, row) for image, row in track]
        model.add_point3D(coordinates[point], pycolmap.Track(elements))
    (target / "gt").mkdir(parents=True, exist_ok=True)
    model.write_text(str(target / "gt"))


def photo_size(path: Path) -> tuple[int, int]:
    """Read (width, height) of an image file.

    Raises:
        InputError: The file cannot be read or is not an image.
    """
    try:
        size = read_header(path.read_bytes()).size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    if size is None:
        raise InputError(f"{path}: no photo")
    return size


def read_image_list(
    path: Path, separator: str | None = None, unit_s: float = 1.0
) -> tuple[Float64, list[str]]:
    """Read a text file with a time stamp and a path of an image in each line.

    Args:
        path: Text file; lines that start with ``#`` are comments.
        separator: Text between time stamp and path, or None for white space.
        unit_s: Unit of the time stamps in seconds.

    Returns:
        Time stamps (n,) in seconds and paths, in ascending order of time.

    Raises:
        InputError: A line has no time stamp or no path.
    """
    rows = []
    for number, line in enumerate(read_text_file(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = [word.strip() for word in line.split(separator, 1)]
        try:
            rows.append((float(words[0]) * unit_s, words[1]))
        except (IndexError, ValueError) as error:
            raise InputError(f"{path}, line {number}: expected a time stamp and a path") from error
    rows.sort()
    return np.array([time for time, _ in rows]), [name for _, name in rows]


def require_path(path: Path, what: str) -> Path:
    """Return a path after checking that it exists.

    Args:
        path: File or folder.
        what: Description of the file for the error message.

    Raises:
        InputError: The file or folder does not exist.
    """
    if not path.exists():
        raise InputError(f"{what} is missing: {path}")
    return path


def pinhole_camera(
    size: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> pycolmap.Camera:
    """Build a COLMAP PINHOLE camera from image size (width, height) and intrinsics."""
    return pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=[fx, fy, cx, cy])


def invert_pose(world_from_cam: Float64) -> Float64:
    """Invert ``world_from_cam`` (4, 4) or (3, 4) to ``cam_from_world`` (3, 4)."""
    rotation = world_from_cam[:3, :3].T
    return np.column_stack([rotation, -rotation @ world_from_cam[:3, 3]])


def resample_depth(
    depth: Float32, depth_camera: pycolmap.Camera, camera: pycolmap.Camera
) -> Float32:
    """Resample a depth map to another camera with the same pose.

    Nearest-neighbor sampling avoids interpolation across depth edges.

    Args:
        depth: (h, w) depth.
        depth_camera: Camera of the depth map, which may have distortion.
        camera: Undistorted camera of the resampled depth map.
    """
    width = min(camera.width, _MAX_DEPTH_COLUMNS)
    height = max(1, round(width * camera.height / camera.width))
    grid = pixel_centers(width, height).reshape(-1, 2)
    xy = grid * [camera.width / width, camera.height / height]
    rays = np.column_stack([camera.cam_from_img(xy), np.ones(len(xy))])
    depth_xy = np.asarray(depth_camera.img_from_cam(rays))
    depth_xy = depth_xy * [
        depth.shape[1] / depth_camera.width,
        depth.shape[0] / depth_camera.height,
    ]
    known = inside(depth_xy, (depth.shape[1], depth.shape[0]))
    values = sample_nearest(depth, np.where(known[:, None], depth_xy, 0.0))
    resampled: Float32 = np.where(known, values, np.float32(0)).reshape(height, width)
    return resampled


def _link(source: Path, target: Path) -> None:
    """Hard-link a file, or copy it if links are impossible."""
    try:
        os.link(source.resolve(), target)
    except OSError:  # A hard link fails on another disk, or if the file system has no hard links.
        shutil.copyfile(source, target)
