"""LightGlue and SuperGlue as sparse matchers of given keypoints.

The models of transformers detect, describe and match keypoints in one pass. To match given
keypoints, a module that returns these keypoints replaces the detector in the models.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from transformers import LightGlueForKeypointMatching, SuperGlueForKeypointMatching

from mpsfm_core import Features, PairMatches, ProviderContext, SparseMatches, View
from mpsfm_core.data import Float64
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import require_features
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_transformers.hub import LoadedModel
from mpsfm_transformers.options import LightGlueOptions, SparseOptions, SuperGlueOptions


class _GivenKeypoints(nn.Module):
    """Replacement of a keypoint detector that returns given keypoints of two images."""

    def __init__(self) -> None:
        super().__init__()
        self.found: tuple[torch.Tensor, ...] = ()

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.found


class GivenKeypointsMatcher:
    """Base class of the matchers of given keypoints."""

    name = ""

    def __init__(
        self, family: Any, options: SparseOptions, context: ProviderContext, **config: Any
    ) -> None:
        self._model = LoadedModel(family, options, context, **config)
        self._dimension = self._model.network.config.keypoint_detector_config.descriptor_decoder_dim
        self._given = _GivenKeypoints()
        self._model.network.keypoint_detector = self._given

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match the features of two views, and return mutual matches with confidence scores.

        Raises:
            ProviderError: The descriptors do not have the dimension that this matcher requires.
        """
        features = require_features(f"{self.name} matches features", features_a, features_b)
        for view, one in zip((view_a, view_b), features, strict=True):
            if one.descriptors.shape[1] != self._dimension:
                raise ProviderError(
                    f"descriptors of {view.name!r} have {one.descriptors.shape[1]} dimensions, "
                    f"this matcher needs {self._dimension}: choose the matcher for these "
                    f"features"
                )
        if not min(map(len, features)):
            return _matches(np.empty((0, 2)), np.empty(0))
        width, height = view_a.camera.size
        self._given.found = self._tensors((view_a, view_b), features)
        size_only = torch.empty(1, device=self._model.device).expand(1, 2, 1, height, width)
        with inference():
            prediction = self._model.network(size_only)
        # The match indices have shape (1, 2, n), or (2, n) for LightGlue without early stopping.
        partners, scores = (
            tensor.reshape(2, -1)[0, : len(features[0])].cpu().numpy()
            for tensor in (prediction.matches, prediction.matching_scores)
        )
        rows = np.flatnonzero((partners >= 0) & (partners < len(features[1])))
        return _matches(np.stack([rows, partners[rows]], axis=1), scores[rows])

    def _tensors(
        self, views: tuple[View, View], features: tuple[Features, Features]
    ) -> tuple[torch.Tensor, ...]:
        """Create the detector output: keypoints, scores, descriptors and mask of two images.

        Keypoint coordinates are divided by the size of the first view.
        """
        count = max(map(len, features))
        keypoints = np.zeros((2, count, 2), dtype=np.float32)
        scores = np.zeros((2, count), dtype=np.float32)
        descriptors = np.zeros((2, count, self._dimension), dtype=np.float32)
        mask = np.zeros((2, count), dtype=np.int32)
        size = np.array(views[0].camera.size)
        for index, (view, one) in enumerate(zip(views, features, strict=True)):
            keypoints[index, : len(one)] = (
                _to_first_view_pixels(one.keypoints, view, views[0]) / size
            )
            scores[index, : len(one)] = 1 if one.scores is None else one.scores
            descriptors[index, : len(one)] = one.descriptors
            mask[index, : len(one)] = 1
        arrays = (keypoints, scores, descriptors, mask)
        return tuple(torch.from_numpy(array).to(self._model.device) for array in arrays)


class LightGlueMatcher(GivenKeypointsMatcher):
    """LightGlue matcher of given keypoints."""

    name = "LightGlue"

    def __init__(self, options: LightGlueOptions, context: ProviderContext) -> None:
        config: dict[str, Any] = {
            "depth_confidence": options.depth_confidence,
            "width_confidence": options.width_confidence,
        }
        if options.min_score is not None:
            config["filter_threshold"] = options.min_score
        super().__init__(LightGlueForKeypointMatching, options, context, **config)


class SuperGlueMatcher(GivenKeypointsMatcher):
    """SuperGlue matcher of given keypoints."""

    name = "SuperGlue"

    def __init__(self, options: SuperGlueOptions, context: ProviderContext) -> None:
        config = {}
        if options.min_score is not None:
            config["matching_threshold"] = options.min_score
        super().__init__(SuperGlueForKeypointMatching, options, context, **config)


def _to_first_view_pixels(xy: Float64, view: View, first: View) -> Float64:
    """Transform keypoints of a view so that the network normalizes them by the view's own size.

    The matching network normalizes the keypoints of both views by the size of the first view, with
    half of the longer side as unit and integer pixel centers.
    """
    view_size, first_size = np.array(view.camera.size), np.array(first.camera.size)
    moved: Float64 = (xy - 0.5 - view_size / 2) * (
        first_size.max() / view_size.max()
    ) + first_size / 2
    return moved


def _matches(indices: Any, scores: Any) -> PairMatches:
    return PairMatches(sparse=SparseMatches.from_best_scores(indices, scores))
