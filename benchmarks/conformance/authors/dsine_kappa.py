"""DSINE with concentration, by its authors' code: see ``common.py``."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import geffnet
import torch
from common import export, photos, save, seeded
from models.dsine import v02_kappa
from torch.nn.functional import pad
from utils import utils

_SETTINGS = SimpleNamespace(  # of exp002_kappa, with the smallest encoder
    NNET_encoder_B=0,
    NNET_decoder_NF=1280,
    NNET_decoder_BN=False,
    NNET_decoder_down=8,
    NNET_learned_upsampling=True,
    NNET_output_dim=4,
    NNET_feature_dim=64,
    NNET_hidden_dim=64,
    NRN_prop_ps=5,
    NRN_num_iter_train=5,
    NRN_num_iter_test=5,
    NRN_ray_relu=True,
)
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class _Here:
    """Coordinates that the constructor wants on the first GPU."""

    def __init__(self, coordinates: torch.Tensor) -> None:
        self._coordinates = coordinates

    def to(self, device: Any) -> torch.Tensor:
        return self._coordinates


class Last(torch.nn.Module):
    """The last of the refinements, as the authors' scripts take it."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: torch.Tensor, intrins: torch.Tensor) -> torch.Tensor:
        return self.model(image, intrins=intrins.clone(), mode="test")[-1]


coordinates, create = v02_kappa.get_pixel_coords, geffnet.create_model
v02_kappa.get_pixel_coords = lambda h, w: _Here(coordinates(h, w))
geffnet.create_model = lambda name, pretrained: create(name, pretrained=False)
with seeded():
    model = Last(v02_kappa.DSINE_v02_kappa(_SETTINGS)).eval()

for index, (image, camera) in enumerate(photos()):
    rgb = torch.tensor(image).permute(2, 0, 1)[None].float() / 255
    height, width = rgb.shape[2:]
    left, right, top, bottom = utils.get_padding(height, width)
    rgb = pad(rgb, (left, right, top, bottom), mode="constant", value=0.0)
    rgb = (rgb - torch.tensor(_MEAN).view(3, 1, 1)) / torch.tensor(_STD).view(3, 1, 1)
    intrins = torch.eye(3)[None]
    intrins[:, 0, 0], intrins[:, 1, 1] = camera["fx"], camera["fy"]
    intrins[:, 0, 2] = camera["cx"] - 0.5 + left  # theirs: centre of the first pixel at 0
    intrins[:, 1, 2] = camera["cy"] - 0.5 + top
    with torch.inference_mode():
        found = model(rgb, intrins)[0, :, top : top + height, left : left + width]
    save(f"reference_{index}", normal=found[:3].permute(1, 2, 0), kappa=found[3])

height, width = 96, 128
export(
    model,
    (torch.rand(1, 3, height, width), torch.eye(3)[None] * 100),
    ["image", "intrins"],
    ["normal"],
    {"image": {2: "height", 3: "width"}, "normal": {2: "height", 3: "width"}},
)
