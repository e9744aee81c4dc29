"""Reconstruction of a rendered room with exact poses and inexact depth, for the dense stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mpsfm_core.data import DepthPrior, Float32, PinholeCamera, View
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
_LOG_STD = 0.15
"""Standard deviation of the log of the inexact depth."""


@dataclass(frozen=True)
class PosedRoom:
    """Reconstruction with smooth depth errors, its views, and true depth by image name."""

    reconstruction: Reconstruction
    views: Mapping[str, View]
    truth: Mapping[str, Float32]
    """Image name -> (h, w) true depth in world units."""

    def errors(self, reconstruction: Reconstruction) -> dict[str, Float32]:
        """Return the relative depth error (h, w) of each image on the grid of the view."""
        return {
            image.name: np.abs(image.depth.depth / self.truth[image.name] - 1)
            for image in reconstruction.images
        }

    def write_images(self, folder: Path) -> ImageSet:
        """Write the views as image files, and load them with their cameras."""
        folder.mkdir(parents=True)
        for name, view in self.views.items():
            cv2.imwrite(str(folder / name), view.image[..., ::-1])
        parameters = ", ".join(map(str, CAMERA.params))
        intrinsics = folder.parent / "intrinsics.yaml"
        intrinsics.write_text(f"1: {{params: [{parameters}], images: all}}", encoding="utf-8")
        return load_images(folder, intrinsics)


def make_posed_room(num_images: int = 4) -> PosedRoom:
    """Render a room from poses 6 degrees apart, and disturb the depth of each image smoothly."""
    scene, images, views, truth = room_scene(), [], {}, {}
    x, y = np.meshgrid(np.linspace(0, 3, CAMERA.width), np.linspace(0, 2, CAMERA.height))
    for index, pose in enumerate(arc_poses(num_images, 6.0)):
        name = f"{index}.png"
        rendered = scene.render(CAMERA, pose)
        views[name] = View(name, rendered.rgb, CAMERA)
        truth[name] = rendered.depth
        wrong = rendered.depth * np.exp(_LOG_STD * np.sin(x + index) * np.cos(y + 2 * index))
        depth = DepthPrior.from_arrays(wrong, (_LOG_STD * wrong) ** 2)
        no_points = np.zeros(0, np.int64)
        images.append(
            RegisteredImage(index, name, CAMERA, pose[:, :3], pose[:, 3], no_points, depth, 1.0)
        )
    return PosedRoom(Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0)), views, truth)
