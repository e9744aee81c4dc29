"""LightGlue in an ONNX file as a sparse matcher."""

from __future__ import annotations

import numpy as np
from mpsfm_onnx.model import Model
from numpy.typing import NDArray

from mpsfm_core import Features, PairMatches, ProviderContext, SparseMatches, View
from mpsfm_core.data import Float64, Int64
from mpsfm_core.providers import require_features
from mpsfm_lightglue_onnx.options import LightGlueOptions

_INPUTS = ("kpts0", "kpts1", "desc0", "desc1")
_OUTPUTS = ("matches0", "mscores0")


class LightGlue:
    """LightGlue matcher in an ONNX file.

    The inputs ``kpts0`` and ``kpts1`` (1, n, 2) are normalized keypoints, and ``desc0`` and
    ``desc1`` (1, n, d) are descriptors. The outputs ``matches0`` and ``mscores0`` are either
    matches (m, 2) and their scores (m,), or index and score (1, n) for every keypoint of the first
    view. An index of -1 in ``matches0`` marks a keypoint without a match.
    """

    def __init__(self, options: LightGlueOptions, context: ProviderContext) -> None:
        self._model = Model(context.resolve_weights(options.model, options.sha256), context)
        self._model.require(_INPUTS, _OUTPUTS, "LightGlue")
        self._min_score = options.min_score

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match the features of two views, and return mutual matches with confidence scores."""
        features_a, features_b = require_features(
            "LightGlue matches features", features_a, features_b
        )
        if not (len(features_a) and len(features_b)):
            return PairMatches(sparse=SparseMatches.from_arrays(np.empty((0, 2)), np.empty(0)))
        feed = {
            "kpts0": _normalised(view_a, features_a)[np.newaxis],
            "kpts1": _normalised(view_b, features_b)[np.newaxis],
            "desc0": features_a.descriptors[np.newaxis],
            "desc1": features_b.descriptors[np.newaxis],
        }
        pairs, scores = _listed(*self._model.run(feed, _OUTPUTS))
        sure = scores >= self._min_score
        return PairMatches(sparse=SparseMatches.from_arrays(pairs[sure], scores[sure]))


def _normalised(view: View, features: Features) -> Float64:
    """Normalize keypoints to the image center and half of the longer side, as in training.

    LightGlue was trained on keypoints with the center of the first pixel at (0, 0).
    """
    size = np.array(view.camera.size, dtype=np.float64)
    normalised: Float64 = (features.keypoints - 0.5 - size / 2) / (size.max() / 2)
    return normalised


def _listed(
    matches: NDArray[np.int64], scores: NDArray[np.float32]
) -> tuple[Int64, NDArray[np.float32]]:
    """Convert both output forms of LightGlue files to index pairs (m, 2) and scores (m,)."""
    if scores.ndim == 1:
        return matches, scores
    there, scores = matches[0], scores[0]
    rows = np.flatnonzero(there >= 0)
    return np.stack([rows, there[rows]], axis=1), scores[rows]
