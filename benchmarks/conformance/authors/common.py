"""What the scripts beside it share: photos in, answers and the exported network out.

Each runs in a process of its own, with the authors' checkout on its search path, in a folder that
has ``photos.json`` and the photos it names. It makes the authors' network with random weights,
writes what their own steps of inference give as ``reference_N.npz``, and the network as
``network.onnx``.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mpsfm_core.model_export.authors import MaskedWrites

warnings.simplefilter("ignore")


@contextmanager
def seeded(seed: int = 0) -> Iterator[None]:
    """Random weights that are the same every time."""
    torch.manual_seed(seed)
    yield


def photos() -> Iterator[tuple[Any, Mapping[str, float]]]:
    """Each photo, (h, w, 3) uint8 RGB, with its camera: width, height, fx, fy, cx, cy."""
    for entry in json.loads(Path("photos.json").read_text(encoding="utf-8")):
        yield np.load(entry["file"]), entry["camera"]


def save(name: str, **tensors: torch.Tensor) -> None:
    """Tensors as NAME.npz."""
    arrays = {key: tensor.detach().cpu().numpy() for key, tensor in tensors.items()}
    np.savez(f"{name}.npz", **arrays)


def export(
    model: torch.nn.Module,
    arguments: tuple[Any, ...],
    inputs: Sequence[str],
    outputs: Sequence[str],
    dynamic: Mapping[str, Mapping[int, str]] | None = None,
    opset: int = 17,
) -> None:
    """The network as ``network.onnx``."""
    with MaskedWrites():
        torch.onnx.export(
            model,
            arguments,
            "network.onnx",
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes=dynamic,
            opset_version=opset,
            dynamo=False,
        )
