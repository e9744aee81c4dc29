"""Run the original code of MASt3R on pairs of consecutive photos; see ``common.py``."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import torch
from common import photos, save
from mpsfm_mast3r.export import export, network
from PIL import Image

from mpsfm_core.providers.model_export.author_script import ExportJob

for name in (
    "torchvision",
    "torchvision.transforms",
):  # MASt3R's code reads only these three attributes of the checkpoint's arguments
    sys.modules[name] = ModuleType(name)
sys.modules["torchvision.transforms"].__dict__.update(
    Compose=lambda steps: lambda image: steps[1](steps[0](image)),
    ToTensor=lambda: lambda image: torch.tensor(np.array(image)).permute(2, 0, 1) / 255,
    Normalize=lambda mean, std: lambda image: (image - mean[0]) / std[0],
)

from dust3r.utils.image import load_images  # noqa: E402
from mast3r.cloud_opt.sparse_ga import extract_correspondences, symmetric_inference  # noqa: E402

_SIZE = 256  # MASt3R's descriptor matching takes minutes for larger images on a CPU


def answers(model: Any, first: Any, second: Any) -> dict[str, Any]:
    """Compute the depth of two views, each in its camera frame, and the matches of both passes."""
    with torch.inference_mode():
        # MASt3R predicts four point maps: views 1 and 2 in the camera frame of view 1, then views
        # 2 and 1 in the camera frame of view 2.
        predictions = symmetric_inference(model, first, second, "cpu")
    features, certainties = (
        [view[key][0] for view in predictions] for key in ("desc", "desc_conf")
    )
    at_a, at_b, _ = extract_correspondences(features, certainties, device="cpu")
    own_frame = {"a": predictions[0], "b": predictions[2]}
    maps = {f"z_{side}": view["pts3d"][0, ..., 2] for side, view in own_frame.items()}
    maps |= {f"confidence_{side}": view["conf"][0] for side, view in own_frame.items()}
    passes = zip(("11", "21", "22", "12"), certainties, strict=True)
    maps |= {f"certainty_{which}": certainty for which, certainty in passes}
    return {**maps, "matches_a": at_a, "matches_b": at_b}


job = ExportJob.from_arguments()
model = network(job.size)
files, sizes = [], []
for index, (image, _) in enumerate(photos(job)):
    sizes.append(torch.tensor(image.shape[1::-1]))
    files.append(str(job.output.with_name(f"photo_{index}.png")))
    Image.fromarray(image).save(files[-1])
loaded = load_images(files, _SIZE, verbose=False)
for index, first in enumerate(loaded):
    other = (index + 1) % len(loaded)
    size = {"size_a": sizes[index], "size_b": sizes[other]}
    save(job, f"reference_{index}", **answers(model, first, loaded[other]), **size)
export(job, model)
