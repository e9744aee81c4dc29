"""Run hloc's NetVLAD by ``python netvlad.py CHECKOUT OUTPUT.onnx PHOTO ...``.

Needs torchvision. Uses random weights in the layout of the published file, without whitening.
Writes the network as ONNX file, and NetVLAD's descriptors of the photos, which hloc's loader reads.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

checkout, output, *photos = sys.argv[1:]
package = ModuleType("hloc")  # importing the package hloc.extractors would import all extractors
package.__path__ = [f"{checkout}/hloc"]
sys.modules["hloc"] = package
from hloc.extractors import netvlad  # noqa: E402

CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
rng = np.random.default_rng(0)


def published(*_: object, **__: object) -> dict[str, object]:
    """Return random weights in the structure that scipy's loadmat reads from NetVLAD's file."""
    layers = [SimpleNamespace(weights=None) for _ in range(34)]
    places = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    for place, (into, out) in zip(places, pairwise(CHANNELS), strict=True):
        kernel = rng.normal(0, (2 / (9 * into)) ** 0.5, (3, 3, into, out))
        layers[place].weights = (kernel, np.zeros(out))
    layers[30].weights = rng.normal(0, 5, (512, 64)), rng.normal(0, 0.1, (512, 64))
    mean = np.tile(np.float32([123.7, 116.8, 103.9]), (1, 1, 1))
    normalization = SimpleNamespace(averageImage=mean)
    return {
        "net": SimpleNamespace(layers=layers, meta=SimpleNamespace(normalization=normalization))
    }


netvlad.loadmat = published
torch.hub.download_url_to_file = lambda url, path: Path(path).touch()
torch.hub.set_dir(str(Path(output).parent))
model = netvlad.NetVLAD({"whiten": False}).eval().requires_grad_(False)
source = Path(checkout, "hloc", "extract_features.py").read_text()
scope: dict[str, object] = {"cv2": __import__("cv2"), "np": np, "PIL": __import__("PIL.Image")}
exec(source[source.index("def resize_image(") : source.index("class ImageDataset(")], scope)


class Exported(torch.nn.Module):
    """NetVLAD from an image (1, 3, h, w) in [0, 1] to its global descriptor."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Compute the descriptor."""
        descriptor: torch.Tensor = model._forward({"image": image})["global_descriptor"]
        return descriptor


found = {}
with torch.inference_mode():
    for path in photos:
        image = scope["cv2"].imread(path)[..., ::-1].astype(np.float32)
        size = image.shape[:2][::-1]
        if max(size) > 1024:  # maximum image size of hloc's configuration "netvlad"
            new = tuple(round(x * (1024 / max(size))) for x in size)
            image = scope["resize_image"](image, new, "cv2_area")
        batch = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)) / 255)[None]
        found[Path(path).stem] = model({"image": batch})["global_descriptor"][0].numpy()
axes = {"image": {2: "h", 3: "w"}}
torch.onnx.export(
    Exported(), torch.rand(1, 3, 96, 128), output, input_names=["image"],
    output_names=["descriptor"], dynamic_axes=axes, dynamo=False,
)  # fmt: skip
np.savez(Path(output).with_suffix(".npz"), **found)
