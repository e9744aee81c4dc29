"""Local features of an image, and matches of an image pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpsfm_core.data.arrays import (
    Bool,
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
    """Sparse local features of one view."""

    keypoints: Float64
    """(n, 2) float64 positions of the keypoints in COLMAP pixels of the undistorted image."""
    descriptors: Float32
    """(n, d) float32 descriptors of the keypoints."""
    scores: Float32 | None = None
    """(n,) float32 detection scores of the keypoints, higher is better (None if unknown)."""
    scales: Float32 | None = None
    """(n,) float32 scales of the keypoints in pixels (None if unknown)."""
    std_px: float = 1.0
    """Std of the localization noise of a keypoint in pixels."""

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

    def select(self, rows: Int64 | Bool) -> Features:
        """Return the features that row indices or a bool mask select."""
        return Features(
            self.keypoints[rows],
            self.descriptors[rows],
            None if self.scores is None else self.scores[rows],
            None if self.scales is None else self.scales[rows],
            self.std_px,
        )

    @classmethod
    def from_arrays(
        cls,
        keypoints: ArrayLike,
        descriptors: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        scales: ArrayLike | None = None,
        std_px: float = 1.0,
    ) -> Features:
        """Build features from arrays of any number type.

        Args:
            keypoints: (n, 2) positions of the keypoints in COLMAP pixels.
            descriptors: (n, d) descriptors, or None for a matcher that needs no descriptors.
            scores: (n,) detection scores of the keypoints, or None.
            scales: (n,) scales of the keypoints in pixels, or None.
            std_px: Std of the localization noise of a keypoint in pixels.

        Raises:
            DataError: An array has a wrong shape, or contains NaN or infinity.
        """
        xy = np.asarray(keypoints, np.float64)
        if descriptors is None:
            descriptors = np.empty((len(xy), 0))
        return cls(
            xy,
            np.asarray(descriptors, np.float32),
            None if scores is None else np.asarray(scores, np.float32),
            None if scales is None else np.asarray(scales, np.float32),
            std_px,
        )

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, eq=False)
class SparseMatches:
    """Matches between the keypoints of two images, as pairs of indices."""

    indices: Int64
    """(m, 2) int64 indices of the matched keypoints in both images. Each keypoint occurs at most
    once."""
    scores: Float32
    """(m,) float32 confidence of each match in [0, 1], with which the mapper weights the match."""

    def __post_init__(self) -> None:
        require_array(self, "indices", np.int64, (None, 2))
        require_array(self, "scores", np.float32, (len(self.indices),))
        require_unit_interval(self.scores, "scores")
        if (self.indices < 0).any():
            raise DataError("indices", "feature indices must not be negative")
        for column in self.indices.T:
            if len(np.unique(column)) != len(column):
                raise DataError(
                    "indices",
                    "matches must use each feature at most once; SparseMatches.from_best_scores "
                    "keeps the best match of each feature",
                )

    @classmethod
    def from_arrays(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """Build matches from index and score arrays of any number type.

        Args:
            indices: (m, 2) indices of the matched keypoints in both images.
            scores: (m,) scores of the matches, clipped to [0, 1].
        """
        clipped = np.clip(scores, 0, 1).astype(np.float32)
        return cls(indices.astype(np.int64), clipped)

    @classmethod
    def from_best_scores(cls, indices: NDArray[Any], scores: NDArray[Any]) -> SparseMatches:
        """Build one-to-one matches, where the best-scored match of each keypoint is kept.

        Args:
            indices: (m, 2) indices of the matched keypoints in both images; a keypoint may occur
                repeatedly.
            scores: (m,) scores of the matches, clipped to [0, 1].
        """
        order = np.argsort(-scores, kind="stable")
        for column in (0, 1):
            order = order[np.sort(np.unique(indices[order, column], return_index=True)[1])]
        return cls.from_arrays(indices[order], scores[order])

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False)
class DenseMatches:
    """Dense matches between positions of two images, without detected keypoints.

    Examples:
        >>> points = np.array([[10.5, 20.5], [30.5, 40.5]])
        >>> len(DenseMatches(points, points + 1, scores=np.ones(2, np.float32)))
        2
    """

    points_a: Float64
    """(m, 2) float64 positions of the matches in COLMAP pixels of the first image."""
    points_b: Float64
    """(m, 2) float64 positions of the matches in COLMAP pixels of the second image."""
    scores: Float32
    """(m,) float32 confidence of each match in [0, 1]."""
    std_px: float = 1.0
    """Std of the localization noise of a match in pixels."""

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
    """Output of a matcher for two images, with sparse or dense matches or both."""

    sparse: SparseMatches | None = None
    """Matches between detected keypoints."""
    dense: DenseMatches | None = None
    """Matches between image positions without keypoints."""
    depth: PairDepth | None = None
    """Depth maps of both images, if the matcher predicts depth."""

    def __post_init__(self) -> None:
        if self.sparse is None and self.dense is None:
            raise DataError("matches", "a matcher must return sparse or dense matches")
