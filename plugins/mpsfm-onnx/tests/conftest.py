"""Fixtures that write network descriptions and create views with known content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from mpsfm_core import PinholeCamera, View


@pytest.fixture
def write_description(tmp_path: Path) -> Callable[..., str]:
    """Return a function that writes a network description to a YAML file."""

    def write(**fields: Any) -> str:
        path = tmp_path / "description.yaml"
        path.write_text(yaml.safe_dump({"name": "tiny", **fields}), encoding="utf-8")
        return str(path)

    return write


@pytest.fixture
def make_view() -> Callable[..., View]:
    """Return a function that creates a view from a size, a color or an image."""

    def make(
        width: int,
        height: int,
        colour: tuple[int, int, int] = (0, 0, 0),
        focal: tuple[float, float] = (500.0, 500.0),
        image: NDArray[np.uint8] | None = None,
    ) -> View:
        if image is None:
            image = np.full((height, width, 3), colour, dtype=np.uint8)
        camera = PinholeCamera(width, height, *focal, width / 2, height / 2)
        return View("view.png", image, camera)

    return make
