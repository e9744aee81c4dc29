"""DINOv2 and DINOv3 as providers of global descriptors."""

from __future__ import annotations

import numpy as np
from transformers import AutoModel

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_transformers.grid import color_image, network_size
from mpsfm_transformers.hub import LoadedModel
from mpsfm_transformers.options import DinoOptions


class Dino:
    """Provider that returns the normalized class token as global descriptor."""

    def __init__(self, options: DinoOptions, context: ProviderContext) -> None:
        self._model = LoadedModel(AutoModel, options, context)
        self._longest = options.resize

    def describe(self, view: View) -> Float32:
        """Compute the unit descriptor (d,) of a view."""
        patch: int = self._model.network.config.patch_size
        size = network_size(view, self._longest, patch)
        image = color_image(view, size, self._model.device)
        mean, std = (
            image.new_tensor(self._model.preprocessor[key])[:, None, None]
            for key in ("image_mean", "image_std")
        )
        with inference():
            prediction = self._model.network(pixel_values=(image - mean) / std)
        token = prediction.last_hidden_state[0, 0].cpu().numpy()
        unit: Float32 = token / np.float32(max(float(np.linalg.norm(token)), 1e-12))
        return unit
