"""Metric3D v2, by its authors' code: see ``common.py``."""

from __future__ import annotations

import sys
from types import ModuleType

import cv2
import torch
from common import export, photos, save, seeded

for name in ("mmcv", "mmcv.utils", "torchvision", "torchvision.ops", "torchvision.ops.misc"):
    sys.modules[name] = ModuleType(name)  # imported, and not used here
sys.modules["mmcv.utils"].collect_env = dict
sys.modules["torchvision.ops.misc"].FrozenBatchNorm2d = torch.nn.Identity

import hubconf  # noqa: E402
from mono.model.decode_heads.RAFTDepthNormalDPTDecoder5 import RAFTDepthNormalDPT5  # noqa: E402

_SIZE = 616, 1064
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


class Exported(torch.nn.Module):
    """As the authors' metric3d_onnx_export.py, with all outputs, named as in public exports."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(_STD).view(1, 3, 1, 1))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        normalised = (image - self.mean) / self.std
        depth, confidence, found = self.model.inference({"input": normalised})
        normal = found["prediction_normal"]
        return depth, normal[:, :3], normal[:, 3], confidence


def answers(model: torch.nn.Module, image, camera) -> dict[str, torch.Tensor]:
    """The steps of the authors' hubconf.py."""
    height, width = image.shape[:2]
    scale = min(_SIZE[0] / height, _SIZE[1] / width)
    rgb = cv2.resize(
        image, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_LINEAR
    )
    h, w = rgb.shape[:2]
    pad_h, pad_w = _SIZE[0] - h, _SIZE[1] - w
    top, left = pad_h // 2, pad_w // 2
    rgb = cv2.copyMakeBorder(
        rgb, top, pad_h - top, left, pad_w - left, cv2.BORDER_CONSTANT, value=_MEAN
    )
    with torch.inference_mode():
        found = model(torch.tensor(rgb).permute(2, 0, 1)[None].float())
    depth, normal, kappa, confidence = (
        tensor.squeeze()[..., top : top + h, left : left + w] for tensor in found
    )
    depth = depth * (camera["fx"] * scale / 1000)
    return {
        "depth": depth,
        "normal": normal.permute(1, 2, 0),
        "kappa": kappa,
        "confidence": confidence,
    }


linspace, grid = torch.linspace, RAFTDepthNormalDPT5.create_mesh_grid
torch.linspace = lambda *values, device=None, **options: linspace(*values, **options)
RAFTDepthNormalDPT5.create_mesh_grid = lambda self, height, width, batch, device="cpu", **options: (
    grid(self, height, width, batch, device="cpu", **options)
)
with seeded():
    model = Exported(hubconf.metric3d_vit_small(pretrain=False)).eval()

for index, (image, camera) in enumerate(photos()):
    save(f"reference_{index}", **answers(model, image, camera))
export(
    model,
    (torch.rand(1, 3, *_SIZE) * 255,),
    ["pixel_values"],
    ["predicted_depth", "predicted_normal", "normal_confidence", "confidence"],
)
