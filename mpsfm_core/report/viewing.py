"""Provide scenes of posed images and points from a run or a folder to viewers.

A viewer is a plugin that implements the hook ``mpsfm_viewers``. The hook ``mpsfm_viewers`` returns
factories, which are called as ``factory(output, pictures)`` and return a :class:`Viewer`. During a
run the viewer is registered as a plugin, so its event hooks are called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Float64,
    PosedImage,
    SceneState,
    UInt8,
)
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import DENSE, SUMMARY, VIEWS
from mpsfm_core.geometry import camera_center, pixel_centers, resize_map, unproject
from mpsfm_core.geometry.pycolmap_conversion import pinhole_from_colmap
from mpsfm_core.inputs.models import read_model
from mpsfm_core.report.result_folder import ResultFolder
from mpsfm_core.results.ply import read_ply

PICTURE_SIDE = 320
"""Longer side of pictures in viewers, in pixels."""
MAX_RELATIVE_STD = 0.3
"""Maximum relative std of shown depth pixels; uncertain pixels would occlude accurate pixels."""
_MAX_PIXELS = 8000
"""Maximum number of shown pixels per depth map."""


class Viewer(Protocol):
    """Viewer of a sequence of scenes."""

    def show(self, scene: SceneState, cloud: ColoredPoints | None = None) -> None:
        """Show a scene in place of the previous scene."""
        ...

    def finish(self) -> str:
        """Finish after the last scene; return a message with the address or file of the viewer."""
        ...

    def wait(self) -> None:
        """Block until the user closes the viewer, unless the viewer only writes files."""
        ...


@dataclass(frozen=True, eq=False)
class ColoredPoints:
    """Colored points in the world frame."""

    xyz: Float64
    """(n, 3) float64 points in world coordinates."""
    rgb: UInt8
    """(n, 3) uint8 RGB colors of the points."""


Pictures = Callable[[str], UInt8 | None]
"""Function from an image name to the downscaled RGB image (h, w, 3) uint8, None if missing."""


def pictures_from_photos(folder: Path) -> Pictures:
    """Return a function that reads downscaled images from a folder of images."""
    return lambda name: _read_picture(folder / name)


def pictures_from_results(folder: Path) -> Pictures:
    """Return a function that reads downscaled images from a result folder."""
    return lambda name: _read_picture(folder / VIEWS / f"{name}.webp")


def unproject_depth_map(image: PosedImage, picture: UInt8 | None) -> ColoredPoints:
    """Unproject a subsampled depth map; points are gray without a picture."""
    depth = image.depth
    if depth is None:
        return ColoredPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    height, width = depth.shape
    pixels = np.flatnonzero(select_certain_pixels(depth))
    pixels = pixels[:: max(1, -(-len(pixels) // _MAX_PIXELS))]
    xy = pixel_centers(width, height).reshape(-1, 2)[pixels]
    local = unproject(image.camera.resized(width, height), xy, depth.depth.ravel()[pixels])
    world = local @ image.rotation + camera_center(image.rotation, image.translation)
    rgb = np.full((len(pixels), 3), 128, np.uint8)
    if picture is not None:
        rgb = np.asarray(resize_map(picture, width, height).reshape(-1, 3)[pixels], np.uint8)
    return ColoredPoints(world, rgb)


def select_certain_pixels(depth: DepthPrior) -> Bool:
    """Return the mask (h, w) of valid depth with relative std up to :data:`MAX_RELATIVE_STD`."""
    if depth.variance is None:
        return depth.valid
    shown: Bool = depth.valid & (depth.variance <= (MAX_RELATIVE_STD * depth.depth) ** 2)
    return shown


def read_scene(folder: Path) -> tuple[SceneState, ColoredPoints, Pictures]:
    """Read a scene from a result folder, COLMAP model or ``transforms.json`` with ``images/``.

    Raises:
        InputError: the folder has no results, no COLMAP model and no ``transforms.json``.
    """
    if (folder / SUMMARY).is_file():
        result = ResultFolder.open(folder)
        if result.failed:
            raise InputError(f"{folder}: the run failed; open {folder}/report.html for the reasons")
        scene, cloud = scene_from_model(result.model)
        if (folder / DENSE).is_file():
            cloud = ColoredPoints(*read_ply(folder / DENSE))
        return scene, cloud, pictures_from_results(folder)
    return *scene_from_model(read_model(folder)), pictures_from_photos(folder / "images")


def scene_from_model(model: pycolmap.Reconstruction) -> tuple[SceneState, ColoredPoints]:
    """Return the registered images of a COLMAP model, sorted by name, and its points."""
    images = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            pose = image.cam_from_world().matrix()
            camera = pinhole_from_colmap(model.cameras[image.camera_id])
            images.append(PosedImage(image.name, camera, pose[:, :3], pose[:, 3], None))
    points = [model.points3D[key] for key in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    return SceneState(tuple(images), xyz), ColoredPoints(xyz, rgb)


def _read_picture(file: Path) -> UInt8 | None:
    """Read an image upright and downscaled, None if the image cannot be read."""
    try:
        data = np.frombuffer(file.read_bytes(), np.uint8)
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        return None
    if bgr is None:
        return None
    rgb = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
    factor = PICTURE_SIDE / max(rgb.shape[:2])
    if factor >= 1:
        return rgb
    size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
