"""Run the original code of DSINE with concentration; see ``common.py``."""

from __future__ import annotations

import torch
from common import photos, save
from mpsfm_dsine.export import ENCODERS, export, network
from torch.nn.functional import pad
from utils import utils

from mpsfm_core.providers.model_export.author_script import ExportJob

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

job = ExportJob.from_arguments()
model = network(ENCODERS[job.size])
for index, (image, camera) in enumerate(photos(job)):
    rgb = torch.tensor(image).permute(2, 0, 1)[None].float() / 255
    height, width = rgb.shape[2:]
    left, right, top, bottom = utils.get_padding(height, width)
    rgb = pad(rgb, (left, right, top, bottom), mode="constant", value=0.0)
    rgb = (rgb - torch.tensor(_MEAN).view(3, 1, 1)) / torch.tensor(_STD).view(3, 1, 1)
    intrins = torch.eye(3)[None]
    intrins[:, 0, 0], intrins[:, 1, 1] = camera["fx"], camera["fy"]
    intrins[:, 0, 2] = camera["cx"] - 0.5 + left  # DSINE: center of the first pixel at 0
    intrins[:, 1, 2] = camera["cy"] - 0.5 + top
    with torch.inference_mode():
        found = model(rgb, intrins)[0, :, top : top + height, left : left + width]
    save(job, f"reference_{index}", normal=found[:3].permute(1, 2, 0), kappa=found[3])
export(job, model)
