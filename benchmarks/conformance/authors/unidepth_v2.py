"""Run the original code of UniDepth V2; see ``common.py``."""

from __future__ import annotations

import cv2
import torch
from common import photos, save
from mpsfm_onnx.export_unidepth import SIZE, export, network
from unidepth.utils.constants import IMAGENET_DATASET_MEAN, IMAGENET_DATASET_STD

from mpsfm_core.providers.model_export.author_script import ExportJob

job = ExportJob.from_arguments()
model = network(job.size)
last = model.pixel_decoder.depth_layer.to_confidence_hr[-1]
torch.nn.init.constant_(last.bias, 1.0)  # the network predicts an absolute error, which is positive
model.resolution_level = 9
model.shape_constraints |= {"pixels_min": 0, "pixels_max": SIZE[0] * SIZE[1]}
mean, std = (torch.tensor(v)[:, None, None] for v in (IMAGENET_DATASET_MEAN, IMAGENET_DATASET_STD))
for index, (image, camera) in enumerate(photos(job)):
    # The exported ONNX file has a fixed input size, but UniDepth's function ``infer`` chooses a
    # size for each photo. Therefore the photo is padded to the input size of the ONNX file first.
    height, width = image.shape[:2]
    scale = min(SIZE[0] / height, SIZE[1] / width)
    h, w = round(height * scale), round(width * scale)
    rgb = cv2.resize(image, (w, h), interpolation=cv2.INTER_LINEAR)
    top, left = (SIZE[0] - h) // 2, (SIZE[1] - w) // 2
    placed = torch.zeros(3, *SIZE)
    inside = ..., slice(top, top + h), slice(left, left + w)
    placed[inside] = (torch.tensor(rgb).permute(2, 0, 1) / 255 - mean) / std
    x, y = w / width, h / height
    matrix = torch.tensor(
        [
            [camera["fx"] * x, 0, camera["cx"] * x + left],
            [0, camera["fy"] * y, camera["cy"] * y + top],
            [0, 0, 1],
        ]
    )
    found = model.infer(placed, matrix[None], normalize=False)
    depth, confidence = (found[key][0, 0][inside] for key in ("depth", "confidence"))
    save(job, f"reference_{index}", depth=depth, confidence=confidence)
export(job, model)
