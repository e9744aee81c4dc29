"""LightGlue as a sparse matcher."""

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
    """A matcher of LightGlue-ONNX.

    Inputs ``kpts0``, ``kpts1`` (1, n, 2), normalised, and ``desc0``, ``desc1`` (1, n, d). Outputs
    ``matches0``, ``mscores0``: of the matches alone, (m, 2) and (m,), or of all keypoints of the
    first view, (1, n), with -1 for those that have no match.
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
        """Mutual matches with their confidence."""
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
    """Keypoints with the image's centre at 0 and its longer side from -1 to 1, from pixels whose
    first has its centre at (0, 0), as in training."""
    size = np.array(view.camera.size, dtype=np.float64)
    normalised: Float64 = (features.keypoints - 0.5 - size / 2) / (size.max() / 2)
    return normalised


def _listed(
    matches: NDArray[np.int64], scores: NDArray[np.float32]
) -> tuple[Int64, NDArray[np.float32]]:
    """Pairs (m, 2) and scores (m,) of either form of the outputs."""
    if scores.ndim == 1:
        return matches, scores
    there, scores = matches[0], scores[0]
    rows = np.flatnonzero(there >= 0)
    return np.stack([rows, there[rows]], axis=1), scores[rows]
