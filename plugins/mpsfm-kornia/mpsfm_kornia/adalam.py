"""AdaLAM as a sparse matcher, which filters nearest neighbors by local affine consistency."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from kornia.feature.adalam.adalam import AdalamFilter, get_adalam_default_config

from mpsfm_core import Features, PairMatches, ProviderContext, SparseMatches, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import require_features
from mpsfm_core.providers.torch_runtime import inference, use_threads
from mpsfm_kornia.options import AdalamOptions

_FEWEST = 2
"""Minimum number of features per image, because AdaLAM compares the nearest and the second nearest
neighbor."""


class AdalamMatcher:
    """AdaLAM matcher for features with any descriptors, without learned weights.

    AdaLAM accepts the matches of an image neighborhood if one affine map explains enough of these
    matches. Keypoint orientations are not compared, because ``Features`` have none. Keypoint scales
    are compared if the features of both images have scales. The score of a match is ``c / (c +
    min_confidence)``, where c is AdaLAM's confidence in the neighborhood.
    """

    def __init__(self, options: AdalamOptions, context: ProviderContext) -> None:
        use_threads(context)
        self._options = options
        self._device = context.device

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match features one-to-one where a local affine map explains the neighboring matches."""
        features_a, features_b = require_features("adalam matches features", features_a, features_b)
        if features_a.descriptors.shape[1] != features_b.descriptors.shape[1]:
            raise ProviderError(
                f"the descriptors of {view_a.name!r} and {view_b.name!r} differ in dimension"
            )
        if min(len(features_a), len(features_b)) < _FEWEST:
            return _matches(np.empty((0, 2)), np.empty(0))
        use_scales = features_a.scales is not None and features_b.scales is not None
        given = [self._tensors(f) for f in (features_a, features_b)]
        with inference():
            indices, inverse = self._filter(use_scales).match_and_filter(
                given[0][0],
                given[1][0],
                given[0][1],
                given[1][1],
                im1shape=view_a.camera.size,
                im2shape=view_b.camera.size,
                s1=given[0][2] if use_scales else None,
                s2=given[1][2] if use_scales else None,
                return_dist=True,
            )
        chance = self._options.min_confidence * inverse.reshape(-1).double().cpu().numpy()
        return _matches(indices.cpu().numpy(), 1 / (1 + chance))

    def _filter(self, use_scales: bool) -> AdalamFilter:
        options = self._options
        config: dict[str, Any] = {
            **get_adalam_default_config(),
            "area_ratio": options.area_ratio,
            "search_expansion": options.search_expansion,
            "min_inliers": options.min_inliers,
            "min_confidence": options.min_confidence,
            "orientation_difference_threshold": None,
            "scale_rate_threshold": options.scale_ratio if use_scales else None,
            "device": torch.device(self._device),
        }
        return AdalamFilter(config)  # kornia disables thresholds that are None

    def _tensors(self, features: Features) -> tuple[torch.Tensor, ...]:
        arrays = (features.keypoints, features.descriptors, features.scales)
        return tuple(
            torch.tensor(array, dtype=torch.float32, device=self._device)
            for array in arrays
            if array is not None
        )


def _matches(indices: Any, scores: Any) -> PairMatches:
    """Select the best match of each feature, because kornia may return several."""
    return PairMatches(sparse=SparseMatches.from_best_scores(indices, scores))
