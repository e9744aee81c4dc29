"""Run the original code of RoMa by ``python roma_warp.py CHECKOUT PHOTO PHOTO OUTPUT``.

Needs torchvision. RoMa's function ``to_pixel_coordinates`` converts the warp to pixels.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from mpsfm_vismatch.seeded_roma import network
from PIL import Image

checkout, first, second, output = sys.argv[1:]
sys.path.insert(0, checkout)
from romatch import roma_outdoor  # noqa: E402

model = network(roma_outdoor)
with torch.inference_mode():
    warp, certainty = model.match(first, second, device="cpu")
    sizes = [Image.open(path).size[::-1] for path in (first, second)]
    a, b = model.to_pixel_coordinates(warp.reshape(-1, 4), *sizes[0], *sizes[1])
np.savez(output, a=a, b=b, certainty=np.squeeze(certainty))  # without batch dimension
