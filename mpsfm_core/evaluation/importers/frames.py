"""What all importers share: frames, and writing them as a scene folder."""

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

PHOTOS = (".jpg", ".jpeg", ".png")
_DEPTH_COLUMNS = 1024
"""Depth that is carried over from another camera is written with at most as many columns."""


@dataclass(frozen=True, eq=False)
class FrameObservations:
    """Points that a photo observes: pixels (p, 2), ids (p,) and world coordinates (p, 3)."""

    xy: Float64
    ids: Int64
    points: Float64


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its truth.

    ``name``: in the scene folder. ``camera``: of the photo. ``pose``: (3, 4) ``cam_from_world``.
    ``depth``: reads its depth map in metres, 0 where unknown, on a grid that covers the photo.
    """

    name: str
    photo: Path
    camera: pycolmap.Camera
    pose: Float64
    depth: Callable[[], Float32] | None = None
    observations: FrameObservations | None = None


def write_frames(target: Path, frames: Sequence[Frame]) -> None:
    """Write photos, cameras, poses, points and depth as a scene folder."""
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
            own = pycolmap.Camera({**frame.camera.todict(), "camera_id": cameras[key]})
            model.add_camera_with_trivial_rig(own)
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
    """(width, height) of a photo; raises :class:`InputError`."""
    try:
        size = read_header(path.read_bytes()).size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    if size is None:
        raise InputError(f"{path}: no photo")
    return size


def need(path: Path, what: str) -> Path:
    """The path if it exists; raises :class:`InputError` that says what was looked for."""
    if not path.exists():
        raise InputError(f"{what} is missing: {path}")
    return path


def pinhole_camera(
    size: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> pycolmap.Camera:
    """A camera of photos of (width, height); ``cx, cy`` in COLMAP pixels."""
    return pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=[fx, fy, cx, cy])


def inverted(world_from_cam: Float64) -> Float64:
    """(3, 4) ``cam_from_world`` of a (4, 4) or (3, 4) ``world_from_cam``."""
    rotation = world_from_cam[:3, :3].T
    return np.column_stack([rotation, -rotation @ world_from_cam[:3, 3]])


def carried_depth(depth: Float32, own: pycolmap.Camera, photo: pycolmap.Camera) -> Float32:
    """Depth of one camera as another one in the same place and direction sees it.

    ``own``: the camera of the map (h, w), maybe distorted. ``photo``: the undistorted camera whose
    view the result covers. The nearest pixel counts: depth is not mixed across edges.
    """
    width = min(photo.width, _DEPTH_COLUMNS)
    height = max(1, round(width * photo.height / photo.width))
    grid = pixel_centers(width, height).reshape(-1, 2)
    xy = grid * [photo.width / width, photo.height / height]
    rays = np.column_stack([photo.cam_from_img(xy), np.ones(len(xy))])
    there = np.asarray(own.img_from_cam(rays))
    there = there * [depth.shape[1] / own.width, depth.shape[0] / own.height]
    known = inside(there, (depth.shape[1], depth.shape[0]))
    values = sample_nearest(depth, np.where(known[:, None], there, 0.0))
    carried: Float32 = np.where(known, values, np.float32(0)).reshape(height, width)
    return carried


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)
