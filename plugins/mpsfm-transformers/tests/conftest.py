"""Test images, and tiny models of the supported architectures with random weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core import PinholeCamera, View


@pytest.fixture(scope="session")
def photo() -> Callable[..., View]:
    """Return a function that creates a view of the sample scene from a size and focal length."""
    path = Path(__file__).resolve().parents[3] / "examples" / "sample_scene" / "images"
    image = cv2.cvtColor(cv2.imread(str(min(path.glob("*.jpg")))), cv2.COLOR_BGR2RGB)

    def make(width: int = 149, height: int = 107, focal: float = 130.0) -> View:
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return View("photo.jpg", resized, camera)

    return make


@pytest.fixture(scope="session")
def blocks() -> Callable[..., Any]:
    """Create a view of 256 x 192 pixels of random colors in blocks of 4 x 4 pixels."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    return cv2.resize(small, (256, 192), interpolation=cv2.INTER_NEAREST)


@pytest.fixture(scope="session")
def view_of() -> Callable[[Any], View]:
    def make(image: Any) -> View:
        height, width = image.shape[:2]
        camera = PinholeCamera(width, height, 200.0, 200.0, width / 2, height / 2)
        return View("view.png", np.ascontiguousarray(image), camera)

    return make
