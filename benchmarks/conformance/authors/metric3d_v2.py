"""Run the original code of Metric3D v2; see ``common.py``."""

from __future__ import annotations

import cv2
import torch
from common import photos, save
from mpsfm_metric3d_onnx.export import SIZE, export, network

from mpsfm_core.providers.model_export.author_script import ExportJob

_PADDING = (123.675, 116.28, 103.53)

job = ExportJob.from_arguments()
model = network(job.size)
last = model.model.depth_model.decoder.normal_predictor[-1]
last.bias.data += torch.tensor([0.0, 0.0, -10.0])  # let predicted normals face the camera

# Photos are resized and padded as in Metric3D's hubconf.py.
for index, (image, camera) in enumerate(photos(job)):
    height, width = image.shape[:2]
    scale = min(SIZE[0] / height, SIZE[1] / width)
    rgb = cv2.resize(
        image, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_LINEAR
    )
    h, w = rgb.shape[:2]
    pad_h, pad_w = SIZE[0] - h, SIZE[1] - w
    top, left = pad_h // 2, pad_w // 2
    rgb = cv2.copyMakeBorder(
        rgb, top, pad_h - top, left, pad_w - left, cv2.BORDER_CONSTANT, value=_PADDING
    )
    with torch.inference_mode():
        found = model(torch.tensor(rgb).permute(2, 0, 1)[None].float())
    depth, normal, kappa, confidence = (
        tensor.squeeze()[..., top : top + h, left : left + w] for tensor in found
    )
    save(
        job,
        f"reference_{index}",
        depth=depth * (camera["fx"] * scale / 1000),
        normal=normal.permute(1, 2, 0),
        kappa=kappa,
        confidence=confidence,
    )
export(job, model)
