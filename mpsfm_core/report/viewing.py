"""What viewers show: posed images with pictures and points, from a run or from a folder.

A viewer is a plugin. It names itself in the hook ``mpsfm_viewers``; what it names is called as
``factory(output, pictures)`` and gives an object with the methods of :class:`Viewer`. During a run
that object is registered as a plugin, so that every event hook it implements is called.
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
"""Depth that is less certain is not shown: it hides the rest (ours)."""
_SHOWN_PIXELS = 8000
"""Of a depth map."""


class Viewer(Protocol):
    """Shows scenes."""

    def show(self, scene: SceneState, cloud: ColoredPoints | None = None) -> None:
        """Show a scene in the place of what was shown before."""
        ...

    def finish(self) -> str:
        """No more scenes come; returns a line that says where to look."""
        ...

    def wait(self) -> None:
        """Stay until the user has seen enough; returns at once where there is a file to open."""
        ...


@dataclass(frozen=True, eq=False)
class ColoredPoints:
    """``xyz``: (n, 3) float64, world units. ``rgb``: (n, 3) uint8."""

    xyz: Float64
    rgb: UInt8


Pictures = Callable[[str], UInt8 | None]
"""Small RGB picture (h, w, 3) uint8 of an image by its name, None where there is none."""


def pictures_from_photos(folder: Path) -> Pictures:
    """Pictures from a folder of photos; a photo that cannot be read has none."""
    return lambda name: _decoded(folder / name)


def pictures_from_results(folder: Path) -> Pictures:
    """Pictures from a result folder."""
    return lambda name: _decoded(folder / VIEWS / f"{name}.webp")


def lifted(image: PosedImage, picture: UInt8 | None) -> ColoredPoints:
    """The depth map of an image as thinned points, grey without a picture, none without depth."""
    depth = image.depth
    if depth is None:
        return ColoredPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    height, width = depth.shape
    pixels = np.flatnonzero(certain(depth))
    pixels = pixels[:: max(1, -(-len(pixels) // _SHOWN_PIXELS))]
    xy = pixel_centers(width, height).reshape(-1, 2)[pixels]
    local = unproject(image.camera.resized(width, height), xy, depth.depth.ravel()[pixels])
    world = local @ image.rotation + camera_center(image.rotation, image.translation)
    rgb = np.full((len(pixels), 3), 128, np.uint8)
    if picture is not None:
        rgb = np.asarray(resize_map(picture, width, height).reshape(-1, 3)[pixels], np.uint8)
    return ColoredPoints(world, rgb)


def certain(depth: DepthPrior) -> Bool:
    """Which pixels (h, w) are worth showing: valid, and not less certain than
    :data:`MAX_RELATIVE_STD`."""
    if depth.variance is None:
        return depth.valid
    shown: Bool = depth.valid & (depth.variance <= (MAX_RELATIVE_STD * depth.depth) ** 2)
    return shown


def read_scene(folder: Path) -> tuple[SceneState, ColoredPoints, Pictures]:
    """A result folder, any COLMAP model, or a ``transforms.json``; its photos lie in ``images/``.

    Raises :class:`InputError` when the folder is none of them.
    """
    if (folder / SUMMARY).is_file():
        result = ResultFolder.open(folder)
        if result.failed:
            raise InputError(f"{folder}: the run failed, open {folder}/report.html instead")
        scene, cloud = scene_from_model(result.model)
        if (folder / DENSE).is_file():
            cloud = ColoredPoints(*read_ply(folder / DENSE))
        return scene, cloud, pictures_from_results(folder)
    return *scene_from_model(read_model(folder)), pictures_from_photos(folder / "images")


def scene_from_model(model: pycolmap.Reconstruction) -> tuple[SceneState, ColoredPoints]:
    """The images of a COLMAP model that have a pose, sorted by name, and its points."""
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


def _decoded(file: Path) -> UInt8 | None:
    """Reduced and upright; None if it is not there or no picture."""
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
