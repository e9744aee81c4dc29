"""Features of an image and matches of an image pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.arrays import (
    Float32,
    Float64,
    Int64,
    require_array,
    require_finite,
    require_unit_interval,
)
from mpsfm_core.data.errors import DataError
from mpsfm_core.data.priors import PairDepth


@dataclass(frozen=True, eq=False)
class Features:
    """Sparse local features of one view.

    ``keypoints``: (n, 2) float64, COLMAP pixels of the view. ``descriptors``: (n, d) float32.
    ``scores``: (n,) float32 detection scores, higher is better, or None. ``scales``: (n,) float32
    keypoint scales in pixels, or None. ``std_px``: localisation noise of a keypoint in pixels.
    """

    keypoints: Float64
    descriptors: Float32
    scores: Float32 | None = None
    scales: Float32 | None = None
    std_px: float = 1.0

    def __post_init__(self) -> None:
        require_array(self, "keypoints", np.float64, (None, 2))
        count = len(self.keypoints)
        require_array(self, "descriptors", np.float32, (count, None))
        require_finite(self, "keypoints")
        require_finite(self, "descriptors")
        for name in ("scores", "scales"):
            if getattr(self, name) is not None:
                require_array(self, name, np.float32, (count,))
                require_finite(self, name)
        if not (np.isfinite(self.std_px) and self.std_px > 0):
            raise DataError("std_px", "must be positive")

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, eq=False)
class SparseMatches:
    """Matches between the features of two views.

    ``indices``: (m, 2) int64, rows of the two feature sets, each used at most once.
    ``scores``: (m,) float32 in [0, 1], confidence of each match; mapping weighs matches by it.
    """

    indices: Int64
    scores: Float32

    def __post_init__(self) -> None:
        require_array(self, "indices", np.int64, (None, 2))
        require_array(self, "scores", np.float32, (len(self.indices),))
        require_unit_interval(self.scores, "scores")
        if (self.indices < 0).any():
            raise DataError("indices", "must not be negative")
        for column in self.indices.T:
            if len(np.unique(column)) != len(column):
                raise DataError("indices", "must use each feature at most once")

    @classmethod
    def from_arrays(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """Build from raw arrays of any number type; scores are clipped to [0, 1]."""
        certain = np.clip(scores, 0, 1).astype(np.float32)
        return cls(indices.astype(np.int64), certain)

    @classmethod
    def from_best_scores(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """As :meth:`from_arrays`; of several matches of one feature the most certain stays."""
        order = np.argsort(-scores, kind="stable")
        for column in (0, 1):
            order = order[np.sort(np.unique(indices[order, column], return_index=True)[1])]
        return cls.from_arrays(indices[order], scores[order])

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False)
class DenseMatches:
    """Matches between free positions of two views (no detector involved).

    ``points_a``, ``points_b``: (m, 2) float64, COLMAP pixels of the two views. ``scores``: (m,)
    float32 in [0, 1]. ``std_px``: localisation noise of a match in pixels.
    """

    points_a: Float64
    points_b: Float64
    scores: Float32
    std_px: float = 1.0

    def __post_init__(self) -> None:
        require_array(self, "points_a", np.float64, (None, 2))
        require_array(self, "points_b", np.float64, (len(self.points_a), 2))
        require_array(self, "scores", np.float32, (len(self.points_a),))
        require_finite(self, "points_a")
        require_finite(self, "points_b")
        require_unit_interval(self.scores, "scores")

    def __len__(self) -> int:
        return len(self.points_a)


@dataclass(frozen=True, eq=False)
class PairMatches:
    """What a matcher returns for two views: sparse or dense matches or both, maybe depth."""

    sparse: SparseMatches | None = None
    dense: DenseMatches | None = None
    depth: PairDepth | None = None

    def __post_init__(self) -> None:
        if self.sparse is None and self.dense is None:
            raise DataError("matches", "a matcher must return sparse or dense matches")
