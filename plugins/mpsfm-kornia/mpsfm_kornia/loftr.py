"""LoFTR as a dense, detector-free matcher."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg

from mpsfm_core import DenseMatches, Features, PairMatches, ProviderContext, View
from mpsfm_core.providers.torch_runtime import SkipRandomWeights, inference, use_threads
from mpsfm_kornia.options import LoftrOptions
from mpsfm_kornia.runtime import Grid, is_inside_mask, load_state, load_weights

_MULTIPLE = 8
"""Side in pixels of the cells that LoFTR matches at its coarse level."""
_STD_NETWORK_PX = 0.5
"""Std of LoFTR's match positions in pixels of the network input.
[reference: half of the noise of sparse keypoints]"""
_LUMA = (0.299, 0.587, 0.114)
"""Luma coefficients of ITU-R BT.601, with which LoFTR was trained."""


class LoftrMatcher:
    """LoFTR matcher with the architecture of the published weights.

    LoFTR's keypoints already use COLMAP's pixel convention (documented by kornia).
    """

    def __init__(self, options: LoftrOptions, context: ProviderContext) -> None:
        use_threads(context)
        self._device = context.device
        self._longest = options.resize
        config: Any = copy.deepcopy(default_cfg)
        config["match_coarse"]["thr"] = options.match_threshold
        config["coarse"]["temp_bug_fix"] = options.corrected_encoding
        with SkipRandomWeights():
            self._network = LoFTR(pretrained=None, config=config)
        state = load_weights(context, options.weights, options.sha256)
        load_state(self._network, state.get("state_dict", state), options.weights)
        self._network.to(self._device)

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match cells of the first view to subpixel positions in the second view."""
        grids = [Grid.fit(view, self._longest, _MULTIPLE) for view in (view_a, view_b)]
        images = [
            self._gray(grid, view) for grid, view in zip(grids, (view_a, view_b), strict=True)
        ]
        with inference():
            output = self._network({"image0": images[0], "image1": images[1]})
        points = [
            grid.to_view(output[key].double().cpu().numpy())
            for grid, key in zip(grids, ("keypoints0", "keypoints1"), strict=True)
        ]
        scores = np.clip(output["confidence"].float().cpu().numpy(), 0, 1)
        keep = is_inside_mask(view_a, points[0]) & is_inside_mask(view_b, points[1])
        return PairMatches(
            dense=DenseMatches(
                points[0][keep],
                points[1][keep],
                scores[keep],
                std_px=max(1.0, _STD_NETWORK_PX * max(grid.pixel_size for grid in grids)),
            )
        )

    def _gray(self, grid: Grid, view: View) -> torch.Tensor:
        image = grid.image(view, self._device)
        return (image * image.new_tensor(_LUMA)[:, None, None]).sum(1, keepdim=True)
