"""Sparse matchers LightGlue for ALIKED, DISK and DeDoDe, and LighterGlue for XFeat."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from kornia.feature import LightGlue

from mpsfm_core import Features, PairMatches, ProviderContext, SparseMatches, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import require_features
from mpsfm_core.providers.torch_runtime import SkipRandomWeights, inference, use_threads
from mpsfm_kornia.attention import fuse_cross_attention
from mpsfm_kornia.options import LightGlueOptions
from mpsfm_kornia.runtime import load_state, load_weights

# The dictionaries below list all settings that determine LightGlue's shape, because other packages
# are known to overwrite kornia's class-level defaults.
_LIGHTGLUE = {"input_dim": 128, "descriptor_dim": 256, "n_layers": 9, "num_heads": 4}
LIGHTGLUE_256 = {**_LIGHTGLUE, "input_dim": 256}
_LIGHTERGLUE = {"input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
_FIXED = {
    "name": "lightglue",
    "add_scale_ori": False,
    "add_laf": False,
    "scale_coef": 1.0,
    "flash": True,
    "mp": False,
    "weights": None,
}


class LightGlueMatcher:
    """LightGlue matcher for the 128-dimensional ALIKED and DISK features."""

    architecture: dict[str, int] = _LIGHTGLUE

    def __init__(self, options: LightGlueOptions, context: ProviderContext) -> None:
        use_threads(context)
        self._device = context.device
        with SkipRandomWeights():
            self._network = LightGlue(
                None,  # type: ignore[arg-type]  # None loads no published weights
                **self.architecture,
                **_FIXED,
                depth_confidence=options.depth_confidence,
                width_confidence=options.width_confidence,
                filter_threshold=options.filter_threshold,
            )
        state = load_weights(context, options.weights, options.sha256)
        load_state(self._network, _renamed(state), options.weights)
        if self._device == "cpu":
            fuse_cross_attention(self._network)
        self._network.to(self._device)

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match the features of two views by LightGlue.

        Returns:
            Mutual matches, with LightGlue's confidence as score.

        Raises:
            ProviderError: The descriptors do not have the dimension that this LightGlue network
                requires.
        """
        features_a, features_b = require_features(
            "LightGlue matches features", features_a, features_b
        )
        if not len(features_a) or not len(features_b):
            return _matches(np.empty((0, 2)), np.empty(0))
        data = {
            "image0": self._input(view_a, features_a),
            "image1": self._input(view_b, features_b),
        }
        with inference():
            output = self._network(data)
        return _matches(output["matches"][0].cpu().numpy(), output["scores"][0].cpu().numpy())

    def _input(self, view: View, features: Features) -> dict[str, torch.Tensor]:
        dimension = features.descriptors.shape[1]
        if dimension != self.architecture["input_dim"]:
            raise ProviderError(
                f"descriptors of {view.name!r} have {dimension} dimensions, this matcher needs "
                f"{self.architecture['input_dim']}: choose the matcher for these features"
            )
        arrays = {
            "keypoints": features.keypoints,
            "descriptors": features.descriptors,
            "image_size": np.array(view.camera.size),
        }
        return {
            key: torch.tensor(value, dtype=torch.float32, device=self._device)[None]
            for key, value in arrays.items()
        }


class DedodeLightGlueMatcher(LightGlueMatcher):
    """LightGlue for the 256-dimensional DeDoDe features."""

    architecture = LIGHTGLUE_256


class LighterGlueMatcher(LightGlueMatcher):
    """LighterGlue for the 64-dimensional XFeat features."""

    architecture = _LIGHTERGLUE


def _matches(indices: Any, scores: Any) -> PairMatches:
    return PairMatches(sparse=SparseMatches.from_arrays(indices, scores))


def _renamed(state: dict[str, Any]) -> dict[str, Any]:
    """Rename the tensors of a published LightGlue file to kornia's names."""
    renamed = {}
    for name, tensor in state.items():
        if name.startswith("extractor."):
            continue
        block, _, rest = name.removeprefix("matcher.").partition(".")
        if block in ("self_attn", "cross_attn"):
            layer, _, rest = rest.partition(".")
            block, rest = f"transformers.{layer}.{block}", rest
        renamed[f"{block}.{rest}" if rest else block] = tensor
    return renamed
