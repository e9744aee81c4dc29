"""Export of Metric3D v2, with all of its outputs, to ONNX by its authors' code.

The command ``mpsfm models export`` runs this module as a program, see
:mod:`mpsfm_core.providers.model_export`.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import torch

from mpsfm_core.providers.model_export.author_script import ExportJob

for _name in ("mmcv", "mmcv.utils", "timm", "timm.models", "timm.models.layers"):
    sys.modules[_name] = ModuleType(_name)  # empty modules for imports that the export does not use
sys.modules["timm.models.registry"] = ModuleType("timm.models.registry")
sys.modules["mmcv.utils"].__dict__["collect_env"] = dict
sys.modules["timm.models.layers"].__dict__.update(trunc_normal_=None, DropPath=None)
sys.modules["timm.models.registry"].__dict__["register_model"] = lambda made: made

import hubconf  # noqa: E402
from mono.model.decode_heads.RAFTDepthNormalDPTDecoder5 import (  # noqa: E402
    ConvLoRA,
    ConvTransposeLoRA,
    LoRALinear,
    RAFTDepthNormalDPT5,
)

SIZE = 616, 1064
"""Height and width of the network input in pixels. The exported ONNX file supports no other input
size."""
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
_MODELS = {
    "": hubconf.metric3d_vit_small,
    "small": hubconf.metric3d_vit_small,
    "large": hubconf.metric3d_vit_large,
    "giant2": hubconf.metric3d_vit_giant2,
}


_LEFT = {
    ConvLoRA: torch.nn.Conv2d,
    ConvTransposeLoRA: torch.nn.ConvTranspose2d,
    LoRALinear: torch.nn.Linear,
}
"""Layer classes that leave weights uninitialized, with the torch classes that initialize them."""


class Named(torch.nn.Module):
    """Module with all outputs of Metric3D, named as in the public ONNX files."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(_STD).view(1, 3, 1, 1))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run the network."""
        normalised = (image - self.mean) / self.std
        depth, confidence, outputs = self.model.inference({"input": normalised})
        normal = outputs["prediction_normal"]
        return depth, normal[:, :3], normal[:, 3], confidence


def network(size: str) -> Named:
    """Create the authors' network on the CPU, which the authors' code does not support."""
    linspace, grid = torch.linspace, RAFTDepthNormalDPT5.create_mesh_grid

    def here(*values: Any, device: Any = None, **options: Any) -> torch.Tensor:
        return linspace(*values, **options)

    def mesh(self: Any, *sides: int, device: Any = None, **options: Any) -> Any:
        return grid(self, *sides, device="cpu", **options)

    torch.linspace, RAFTDepthNormalDPT5.create_mesh_grid = here, mesh
    model = _MODELS[size](pretrain=False)
    for module in model.modules():
        for theirs, of_torch in _LEFT.items():
            if isinstance(module, theirs):
                of_torch.reset_parameters(module)
    return Named(model).eval()


def export(job: ExportJob, model: Named) -> None:
    """Export Metric3D for images of the fixed input size, with values from 0 to 255."""
    given = [{"pixel_values": torch.rand(1, 3, *SIZE) * 255} for _ in range(2)]
    outputs = ["predicted_depth", "predicted_normal", "normal_confidence", "confidence"]
    job.export(model, given, outputs)


def main() -> None:
    """Export Metric3D with the weights of a checkpoint."""
    job = ExportJob.from_arguments()
    model = network(job.size)
    if job.weights is not None:
        job.load(model.model, job.checkpoint()["model_state_dict"])
    export(job, model)


if __name__ == "__main__":
    main()
