"""Photos of the comparisons with authors' code, and the runner of the authors' scripts."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from mpsfm_core import PinholeCamera, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers.environments.environment import Environment

AUTHORS = Path(__file__).parent / "authors"
_SAMPLES = Path(__file__).parents[2] / "examples" / "sample_scene" / "images"
_CAMERAS = ((640, 480, 620.0), (333, 500, 410.0), (517, 389, 900.0))
"""Width, height, focal length in pixels of photos: landscape, portrait, odd sizes."""


def photos(
    folder: Path, cameras: Sequence[tuple[int, int, float]] = _CAMERAS, how: int = cv2.INTER_AREA
) -> list[View]:
    """Resize photos of the sample scene, and write them for the authors' script."""
    views, entries = [], []
    for index, (path, (width, height, focal)) in enumerate(
        zip(sorted(_SAMPLES.glob("*.jpg")), cameras, strict=False)
    ):
        image = cv2.resize(cv2.imread(str(path)), (width, height), interpolation=how)
        cv2.imwrite(str(folder / f"photo_{index}.png"), image)
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        view = View(path.name, image[..., ::-1].copy(), camera)
        np.save(folder / f"photo_{index}.npy", view.image)
        views.append(view)
        entries.append({"file": f"photo_{index}.npy", "camera": vars(camera)})
    (folder / "photos.json").write_text(json.dumps(entries), encoding="utf-8")
    return views


def run_authors(environment: Environment, script: str, *arguments: Path) -> None:
    """Run a script of the folder ``authors`` in a Python environment.

    Raises:
        ProviderError: The authors' script failed; the message is the last line of its error output.
    """
    command = [str(part) for part in (environment.python, AUTHORS / script, *arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        message = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise ProviderError(f"the authors' script {script} failed: {message}")
