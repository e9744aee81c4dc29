"""SuperPoint as a feature provider."""

from __future__ import annotations

import numpy as np
from transformers import SuperPointForKeypointDetection

from mpsfm_core import Features, ProviderContext, View
from mpsfm_core.geometry import scale_pixels
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_transformers.grid import gray_image, is_inside_mask, network_size
from mpsfm_transformers.hub import LoadedModel
from mpsfm_transformers.options import SuperPointOptions

_CELL = 8
"""Side in pixels of the cells in which SuperPoint scores keypoints."""


class SuperPointFeatures:
    """SuperPoint features. The library transformers places pixel centers at integer coordinates."""

    def __init__(self, options: SuperPointOptions, context: ProviderContext) -> None:
        # -1 keeps all keypoints, because the mask may remove some of them.
        config: dict[str, float] = {"max_keypoints": -1}
        if options.detection_threshold is not None:
            config |= {"keypoint_threshold": options.detection_threshold}
        self._model = LoadedModel(SuperPointForKeypointDetection, options, context, **config)
        self._options = options

    def extract(self, view: View) -> Features:
        """Extract the strongest keypoints inside the mask, by decreasing score.

        The keypoint noise ``std_px`` is 1 pixel of the view, or one pixel of the resized image if
        that is larger.
        """
        size = network_size(view, self._options.resize, _CELL)
        with inference():
            prediction = self._model.network(gray_image(view, size, self._model.device))
        count = int(prediction.mask[0].sum())
        relative, scores, descriptors = (
            tensor[0, :count].cpu().numpy()
            for tensor in (prediction.keypoints, prediction.scores, prediction.descriptors)
        )
        pixels = np.round(relative.astype(np.float64) * size) + 0.5
        keypoints = scale_pixels(pixels, size, view.camera.size)
        order = np.argsort(-scores, kind="stable")
        order = order[is_inside_mask(view, keypoints[order])][: self._options.max_keypoints]
        pixel_size = max(v / n for v, n in zip(view.camera.size, size, strict=True))
        return Features(
            keypoints=keypoints[order],
            descriptors=descriptors[order],
            scores=scores[order],
            std_px=max(1.0, pixel_size),
        )
