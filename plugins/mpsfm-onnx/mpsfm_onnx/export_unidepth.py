"""Export of UniDepth V2 with camera input to ONNX by its authors' code.

The command ``mpsfm models export`` runs this module as a program, see
:mod:`mpsfm_core.providers.model_export`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from mpsfm_core.providers.model_export.author_script import ExportJob


def _unused(name: str, **has: Any) -> None:
    """Create an empty module for an import of the authors' code that the export does not use."""
    module = sys.modules[name] = ModuleType(name)
    module.__dict__.update(has)


_LAYERS = dict.fromkeys(
    ("AvgPool2dSame", "GlobalResponseNormMlp", "LayerNorm", "LayerNorm2d", "Mlp", "create_conv2d")
)
_LAYERS |= dict.fromkeys(("DropPath", "get_act_layer", "make_divisible", "to_ntuple"))
for _name in ("timm", "timm.models", "torchvision", "torchvision.transforms"):
    _unused(_name)
_unused("timm.layers", trunc_normal_=torch.nn.init.trunc_normal_, **_LAYERS)
_unused("timm.models.layers", **vars(sys.modules["timm.layers"]))
_unused("torchvision.transforms.functional")
_unused("torchvision.transforms.v2")
_unused("torchvision.transforms.v2.functional")
_unused("unidepth.utils.visualization", colorize=None, image_grid=None, log_train_artifacts=None)

from unidepth.models.unidepthv2.export import UniDepthV2ONNXcam  # noqa: E402
from unidepth.utils.camera import Pinhole  # noqa: E402

SIZE = 462, 630
"""Height and width of the network input in pixels. The exported ONNX file supports no other input
size."""
_MODELS = {"": "l", "small": "s", "base": "b", "large": "l"}


def network(size: str) -> UniDepthV2ONNXcam:
    """Create the UniDepth network as in the ONNX export of UniDepth's authors."""
    name = f"config_v2_vit{_MODELS[size]}14.json"
    config = json.loads(Path("configs", name).read_text(encoding="utf-8"))
    config["training"]["export"] = True
    return UniDepthV2ONNXcam(config).eval()


def export(job: ExportJob, model: UniDepthV2ONNXcam) -> None:
    """Export UniDepth for inputs of images, with the fixed size, and the unit rays of pixels."""
    given = []
    for focal in (400.0, 700.0):
        matrix = torch.tensor([[focal, 0, SIZE[1] / 2], [0, focal, SIZE[0] / 2], [0, 0, 1]])
        rays = Pinhole(K=matrix[None]).get_rays((1, *SIZE))
        given.append({"rgbs": torch.randn(1, 3, *SIZE), "rays": rays})
    torch.linspace = _linspace
    job.export(model, given, ["pts_3d", "confidence", "intrinsics"])


def _linspace(start: float, end: float, steps: int, **_: Any) -> torch.Tensor:
    """Create a float32 constant where the ONNX exporter would create a float64 one."""
    return torch.tensor(np.linspace(start, end, steps), dtype=torch.float32)


def main() -> None:
    """Export UniDepth with the weights of a checkpoint."""
    job = ExportJob.from_arguments()
    model = network(job.size)
    if job.weights is not None:
        job.load(model, {**dict(model.named_buffers()), **job.checkpoint()})
    export(job, model)


if __name__ == "__main__":
    main()
