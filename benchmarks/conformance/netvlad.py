"""Comparison of NetVLAD in ``global-onnx`` with the NetVLAD of hloc.

A script exports hloc's NetVLAD with random weights, and ``global-onnx`` runs the ONNX file.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.conformance.shared import photos, run_authors
from mpsfm_core import ProviderContext
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.registry import Registry

_CAMERAS = ((640, 480, 500.0), (333, 500, 500.0), (1601, 1203, 500.0), (900, 1300, 500.0))
_LARGEST = 1024
"""Longer side in pixels to which hloc shrinks photos for NetVLAD."""
APART = "(two photos)"
"""Label of the descriptor distance between different photos, a scale for the differences."""


def compare(environment: Environment, checkout: Path) -> dict[str, float]:
    """Compute the largest descriptor distance to hloc's NetVLAD, for original and shrunk photos."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        views = photos(folder, _CAMERAS, cv2.INTER_CUBIC)
        model = folder / "netvlad.onnx"
        files = [folder / f"photo_{index}.png" for index in range(len(views))]
        run_authors(environment, "netvlad.py", checkout, model, *files)
        options = {"model": str(model), "network": "netvlad"}
        context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
        provider = Registry.discover().create("retrieval", "global-onnx", options, context)
        distances = {"as they are": 0.0, "shrunk": 0.0}
        with np.load(model.with_suffix(".npz")) as theirs:
            for index, view in enumerate(views):
                off = np.linalg.norm(provider.describe(view) - theirs[f"photo_{index}"])
                key = "shrunk" if max(view.camera.size) > _LARGEST else "as they are"
                distances[key] = max(distances[key], float(off))
            distances[APART] = float(np.linalg.norm(theirs["photo_0"] - theirs["photo_1"]))
    return distances
