"""Run the original code of MoGe-2; see ``common.py``."""

from __future__ import annotations

import math

import torch
from common import photos, save
from moge.model.v2 import MoGeModel
from moge.utils.geometry_torch import normalized_view_plane_uv
from mpsfm_onnx.export_moge import TOKENS, export, small_with_normals

from mpsfm_core.providers.model_export.author_script import ExportJob

_SHIFT, _FOCAL = 0.7, 1.4


class Seeing(MoGeModel):
    """MoGe-2 network whose points are moved towards the pixel rays, to determine the shift of z."""

    def _remap_points(self, points):
        points = super()._remap_points(points)
        height, width = points.shape[1:3]
        uv = normalized_view_plane_uv(width, height, dtype=points.dtype, device=points.device)
        z = points[..., 2:]
        return torch.cat([0.1 * points[..., :2] + uv * (z + _SHIFT) / _FOCAL, z], dim=-1)


job = ExportJob.from_arguments()
model = Seeing(**small_with_normals()).eval()
for block in model.encoder.backbone.blocks:  # replace identity layers
    torch.nn.init.constant_(block.ls1.gamma, 1.0)
    torch.nn.init.constant_(block.ls2.gamma, 1.0)
last = [module for module in model.normal_head.modules() if isinstance(module, torch.nn.Conv2d)]
last[-1].bias.data += torch.tensor([0.0, 0.0, -1.0])  # let predicted normals face the camera
for index, (image, camera) in enumerate(photos(job)):
    fov = math.degrees(2 * math.atan(camera["width"] / 2 / camera["fx"]))
    model.onnx_compatible_mode = True
    found = model.infer(
        torch.tensor(image).permute(2, 0, 1) / 255, num_tokens=TOKENS, fov_x=fov, use_fp16=False
    )
    save(job, f"reference_{index}", **{key: found[key] for key in ("depth", "normal", "mask")})
export(job, model)
