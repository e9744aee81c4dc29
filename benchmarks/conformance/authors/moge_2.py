"""MoGe-2, by its authors' code: see ``common.py``."""

from __future__ import annotations

import math

import torch
from common import export, photos, save, seeded
from moge.model.v2 import MoGeModel
from moge.utils.geometry_torch import normalized_view_plane_uv

_DIMS = [384, 64, 32, 16, 8]
_NONE = {"res_block_in_norm": "none", "res_block_hidden_norm": "none"}
_STEPS = ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"]
_TOKENS = 1800
_SHIFT, _FOCAL = 0.7, 1.4


def _head(channels: int) -> dict:
    return {
        "dim_in": _DIMS,
        "dim_out": [None] * 4 + [channels],
        "dim_res_blocks": _DIMS,
        "num_res_blocks": [0, 1, 1, 1, 0],
        "resamplers": _STEPS,
        **_NONE,
    }


class Seeing(MoGeModel):
    """What random weights lack: points near the rays that pixels see, so that the shift has an
    answer."""

    def _remap_points(self, points):
        points = super()._remap_points(points)
        height, width = points.shape[1:3]
        uv = normalized_view_plane_uv(width, height, dtype=points.dtype, device=points.device)
        z = points[..., 2:]
        return torch.cat([0.1 * points[..., :2] + uv * (z + _SHIFT) / _FOCAL, z], dim=-1)


with seeded():
    model = Seeing(
        encoder={"backbone": "dinov2_vits14", "intermediate_layers": [2, 5, 8, 11], "dim_out": 384},
        neck={
            "dim_in": [386, 2, 2, 2, 2],
            "dim_out": None,
            "dim_res_blocks": _DIMS,
            "num_res_blocks": [0, 2, 2, 2, 0],
            "resamplers": _STEPS,
            **_NONE,
        },
        points_head=_head(3),
        normal_head=_head(3),
        mask_head=_head(1),
        scale_head={"dims": [384, 384, 1]},
        remap_output="exp",
        num_tokens_range=[1200, 3600],
    ).eval()
    for block in model.encoder.backbone.blocks:  # else it starts as the identity
        torch.nn.init.constant_(block.ls1.gamma, 1.0)
        torch.nn.init.constant_(block.ls2.gamma, 1.0)
    last = [module for module in model.normal_head.modules() if isinstance(module, torch.nn.Conv2d)]
    last[-1].bias.data += torch.tensor([0.0, 0.0, -1.0])  # facing the camera, as trained ones do

for index, (image, camera) in enumerate(photos()):
    fov = math.degrees(2 * math.atan(camera["width"] / 2 / camera["fx"]))
    for name, mode in (("reference", True), ("smoothed", False)):
        model.onnx_compatible_mode = mode
        found = model.infer(
            torch.tensor(image).permute(2, 0, 1) / 255,
            num_tokens=_TOKENS,
            fov_x=fov,
            use_fp16=False,
        )
        save(f"{name}_{index}", **{key: found[key] for key in ("depth", "normal", "mask")})

model.onnx_compatible_mode = True
export(
    model,
    (torch.rand(1, 3, 518, 518), torch.tensor(_TOKENS)),
    ["image", "num_tokens"],
    ["points", "normal", "mask", "scale"],
    {"image": {2: "height", 3: "width"}},
    opset=14,
)
