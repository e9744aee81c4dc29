"""Efficient LoFTR as a dense matcher."""

from __future__ import annotations

import numpy as np
import torch
from transformers import EfficientLoFTRForKeypointMatching

from mpsfm_core import DenseMatches, Features, PairMatches, ProviderContext, View
from mpsfm_core.geometry import scale_pixels
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_transformers.grid import gray_image, is_inside_mask, network_size
from mpsfm_transformers.hub import LoadedModel
from mpsfm_transformers.options import EfficientLoftrOptions

_MULTIPLE = 32
_STD_NETWORK_PX = 0.5
"""Std of match positions in pixels of the network input.
[reference: half of the noise of sparse keypoints]"""


class _Paired(EfficientLoFTRForKeypointMatching):  # transformers is untyped
    """Efficient LoFTR with a corrected pairing of its matches.

    transformers 5.23 lists the matched cells of both images in different orders, but pairs them as
    if the orders were equal. This class sorts the matched cells of both images by the cells of the
    first image.
    """

    def _get_matches_from_scores(self, scores: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        indices, certainty = super()._get_matches_from_scores(scores)
        partners, certain = indices[:, 1], certainty[:, 1]
        cells = torch.arange(partners.shape[1], device=partners.device).expand_as(partners)
        cells = torch.where(partners >= 0, cells, -1)
        return torch.stack([cells, partners], dim=1), torch.stack([certain, certain], dim=1)


class EfficientLoftrMatcher:
    """Dense matcher by Efficient LoFTR, with match positions in COLMAP pixels.

    Both views are placed at the upper left of input images of equal size.
    """

    def __init__(self, options: EfficientLoftrOptions, context: ProviderContext) -> None:
        config = {}
        if options.min_score is not None:
            config["coarse_matching_threshold"] = options.min_score
        self._model = LoadedModel(_Paired, options, context, **config)
        self._longest = options.resize

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two views at subpixel accuracy, with LoFTR's coarse scores as match scores."""
        views = (view_a, view_b)
        sizes = [network_size(view, self._longest, _MULTIPLE) for view in views]
        canvas = max(width for width, _ in sizes), max(height for _, height in sizes)
        with inference():
            prediction = self._model.network(self._pair(views, sizes, canvas))
        scores = prediction.matching_scores[0].cpu().numpy()
        chosen = (prediction.matches[0].cpu().numpy() >= 0) & (scores > 0)
        relative = prediction.keypoints[0].double().cpu().numpy()
        points = [
            scale_pixels(relative[side][chosen[side]] * canvas, size, view.camera.size)
            for side, (view, size) in enumerate(zip(views, sizes, strict=True))
        ]
        certain = np.clip(scores[0][chosen[0]], 0, 1).astype(np.float32)
        keep = is_inside_mask(view_a, points[0]) & is_inside_mask(view_b, points[1])
        pixel_size = max(
            v / n
            for view, size in zip(views, sizes, strict=True)
            for v, n in zip(view.camera.size, size, strict=True)
        )
        std_px = max(1.0, _STD_NETWORK_PX * pixel_size)
        dense = DenseMatches(points[0][keep], points[1][keep], certain[keep], std_px)
        return PairMatches(dense=dense)

    def _pair(
        self, views: tuple[View, View], sizes: list[tuple[int, int]], canvas: tuple[int, int]
    ) -> torch.Tensor:
        """Stack two views in one tensor (1, 2, 3, h, w), each at the upper left of its image."""
        images = torch.zeros(1, 2, 3, canvas[1], canvas[0], device=self._model.device)
        for side, (view, (width, height)) in enumerate(zip(views, sizes, strict=True)):
            images[0, side, :, :height, :width] = gray_image(
                view, (width, height), self._model.device
            )[0]
        return images
