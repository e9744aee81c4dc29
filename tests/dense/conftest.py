"""Fixture of a rendered room with exact poses and inexact depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, Float32, PinholeCamera, View
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
STD = 0.15


@dataclass(frozen=True)
class Room:
    """Reconstruction with smooth depth errors, its views, and true depth by image name."""

    reconstruction: Reconstruction
    views: Mapping[str, View]
    truth: Mapping[str, Float32]

    def errors(self, reconstruction: Reconstruction) -> dict[str, np.ndarray]:
        """Return the relative depth error of each image on the grid of the view."""
        return {
            image.name: np.abs(image.depth.depth / self.truth[image.name] - 1)
            for image in reconstruction.images
        }


@pytest.fixture(scope="session")
def room() -> Room:
    scene, images, views, truth = room_scene(), [], {}, {}
    x, y = np.meshgrid(np.linspace(0, 3, CAMERA.width), np.linspace(0, 2, CAMERA.height))
    for index, pose in enumerate(arc_poses(4, 6.0)):
        name = f"{index}.png"
        rendered = scene.render(CAMERA, pose)
        views[name] = View(name, rendered.rgb, CAMERA)
        truth[name] = rendered.depth
        wrong = rendered.depth * np.exp(STD * np.sin(x + index) * np.cos(y + 2 * index))
        depth = DepthPrior.from_arrays(wrong, (STD * wrong) ** 2)
        no_points = np.zeros(0, np.int64)
        images.append(
            RegisteredImage(index, name, CAMERA, pose[:, :3], pose[:, 3], no_points, depth, 1.0)
        )
    return Room(Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0)), views, truth)
