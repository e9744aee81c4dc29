"""Input and output of the scripts that run the original code of networks.

Each script exports a network like the export script of a plugin
(:mod:`mpsfm_core.providers.model_export.author_script`). The script reads ``photos.json`` and the
photos in its output folder. Each script runs the original inference code on each photo, and writes
the predictions to ``reference_N.npz``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mpsfm_core.providers.model_export.author_script import ExportJob


def photos(job: ExportJob) -> Iterator[tuple[Any, Mapping[str, float]]]:
    """Yield each photo, (h, w, 3) uint8 RGB, and its camera: width, height, fx, fy, cx, cy."""
    folder = job.output.parent
    for entry in json.loads((folder / "photos.json").read_text(encoding="utf-8")):
        yield np.load(folder / entry["file"]), entry["camera"]


def save(job: ExportJob, name: str, **tensors: torch.Tensor) -> None:
    """Save the predictions of a network as arrays in NAME.npz."""
    arrays = {key: tensor.detach().cpu().numpy() for key, tensor in tensors.items()}
    np.savez(Path(job.output.parent, f"{name}.npz"), **arrays)
