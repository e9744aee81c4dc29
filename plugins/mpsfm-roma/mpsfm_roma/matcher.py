"""RoMa as a dense and as a sparse matcher."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core import (
    DenseMatches,
    Features,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.providers import require_features
from mpsfm_roma.network import OnnxWarpNetwork, Warp, WarpNetwork
from mpsfm_roma.options import DenseSearch, SparseSearch


class DenseMatcher:
    """Dense matcher that samples positions of RoMa's warp with a high certainty."""

    network: ClassVar[Callable[..., WarpNetwork]] = OnnxWarpNetwork

    def __init__(self, options: DenseSearch, context: ProviderContext) -> None:
        self._network = self.network(options, context)
        self._cell, self._min_certainty = options.cell, options.min_certainty

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two views by the warp from a to b and, for a symmetric model, from b to a."""
        there, back = self._network.warps(view_a, view_b)
        xy_a, xy_b, scores = self._thinned(there)
        if back is not None:
            more_b, more_a, scores_back = self._thinned(back)
            xy_a, xy_b = np.concatenate([xy_a, more_a]), np.concatenate([xy_b, more_b])
            scores = np.concatenate([scores, scores_back])
        return PairMatches(dense=DenseMatches(xy_a, xy_b, scores))

    def _thinned(self, warp: Warp) -> tuple[Float64, Float64, Float32]:
        """Select the best match per grid cell, as positions in both views and scores."""
        rows, columns = _best_of_cells(warp.certainty, self._cell)
        scores = warp.certainty[rows, columns]
        sure = scores > self._min_certainty
        rows, columns = rows[sure], columns[sure]
        return warp.source(rows, columns), warp.target[rows, columns], scores[sure]


class SparseMatcher:
    """Sparse matcher of keypoints that RoMa's warp maps close to each other."""

    network: ClassVar[Callable[..., WarpNetwork]] = OnnxWarpNetwork

    def __init__(self, options: SparseSearch, context: ProviderContext) -> None:
        self._network = self.network(options, context)
        self._snap_px, self._min_certainty = options.snap_px, options.min_certainty

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match keypoints one-to-one, in the order of decreasing certainty."""
        features_a, features_b = require_features(
            "roma-sparse matches keypoints", features_a, features_b
        )
        there, back = self._network.warps(view_a, view_b)
        xy_a, xy_b = features_a.keypoints, features_b.keypoints
        pairs, scores = self._snapped(there, xy_a, xy_b)
        if back is not None:
            pairs_back, certain = self._snapped(back, xy_b, xy_a)
            pairs = np.concatenate([pairs, pairs_back[:, ::-1]])
            scores = np.concatenate([scores, certain])
        return PairMatches(sparse=SparseMatches.from_best_scores(pairs, scores))

    def _snapped(self, warp: Warp, xy: Float64, others: Float64) -> tuple[Int64, Float32]:
        """Find pairs (m, 2) of a keypoint and the nearest keypoint to its warped position.

        A keypoint pair is accepted if its distance is small and no other keypoint is warped closer.
        """
        if not (len(xy) and len(others)):
            return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.float32)
        target, certainty = warp.at(xy)
        distance, nearest = cKDTree(others).query(target)
        sure = (distance <= self._snap_px) & (certainty > self._min_certainty)
        rows = np.flatnonzero(sure)
        rows = rows[np.argsort(distance[rows], kind="stable")]
        rows = rows[np.unique(nearest[rows], return_index=True)[1]]
        scores = np.clip(certainty[rows], 0, 1).astype(np.float32)
        return np.stack([rows, nearest[rows]], axis=1).astype(np.int64), scores


def _best_of_cells(certainty: Float32, cell: int) -> tuple[Int64, Int64]:
    """Find row and column of the largest value in each square of ``cell`` x ``cell`` pixels."""
    height, width = certainty.shape
    down, across = -(-height // cell), -(-width // cell)
    padded = np.full((down * cell, across * cell), -1, dtype=np.float32)
    padded[:height, :width] = certainty
    cells = padded.reshape(down, cell, across, cell).swapaxes(1, 2).reshape(down, across, -1)
    y, x = np.divmod(cells.argmax(axis=2), cell)
    rows = y + cell * np.arange(down)[:, None]
    columns = x + cell * np.arange(across)
    return rows.reshape(-1), columns.reshape(-1)
