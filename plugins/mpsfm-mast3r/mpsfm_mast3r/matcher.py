"""MASt3R as a dense and as a sparse matcher, both with depth of the image pair.

The MASt3R network runs twice, with either view of a pair as the first one. Depth is most accurate
in the frame of the first view, and the merged matches of both passes are better than those of one
pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from mpsfm_core import (
    DenseMatches,
    Features,
    PairDepth,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.data import Float32, Int64
from mpsfm_core.geometry import inside
from mpsfm_core.providers import require_features
from mpsfm_mast3r.neighbors import find_mutual, find_reciprocal
from mpsfm_mast3r.network import OnnxPairNetwork, PairNetwork, ViewOutput
from mpsfm_mast3r.options import DenseSearch, SparseSearch

_STD_NETWORK_PX = 0.5
"""Std of dense match positions in pixels of the network input. [reference]"""


class DenseMatcher:
    """Dense matcher by reciprocal nearest neighbors among MASt3R's descriptors of all pixels."""

    network: ClassVar[Callable[..., PairNetwork]] = OnnxPairNetwork

    def __init__(self, options: DenseSearch, context: ProviderContext) -> None:
        self._network = self.network(options, context)
        self._subsample = options.subsample

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two views, and return the merged matches of both network passes."""
        passes = self._network.both(view_a, view_b)
        pairs_by_pass = [self._reciprocal(a, b) for a, b in passes]
        scores = [_scores(a, b, pairs) for (a, b), pairs in zip(passes, pairs_by_pass, strict=True)]
        pairs, certain = _merge(np.concatenate(pairs_by_pass), np.concatenate(scores))
        a, b = passes[0]
        xy_a, xy_b = a.positions(pairs[:, 0]), b.positions(pairs[:, 1])
        keep = inside(xy_a, view_a.camera.size) & inside(xy_b, view_b.camera.size)
        std_px = max(1.0, _STD_NETWORK_PX * max(a.pixel_size, b.pixel_size))
        dense = DenseMatches(xy_a[keep], xy_b[keep], certain[keep], std_px)
        return PairMatches(dense=dense, depth=_depth(passes))

    def _reciprocal(self, a: ViewOutput, b: ViewOutput) -> Int64:
        """Find index pairs (m, 2) of matching descriptors by reciprocal search from both views."""
        there = find_reciprocal(a.descriptors, b.descriptors, self._start(a))
        back = find_reciprocal(b.descriptors, a.descriptors, self._start(b))
        return np.unique(np.concatenate([there, back[:, ::-1]]), axis=0)

    def _start(self, output: ViewOutput) -> Int64:
        width, height = output.canvas.size
        step = self._subsample
        rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
        start: Int64 = (rows * width + columns).reshape(-1).astype(np.int64)
        return start


class SparseMatcher:
    """Sparse matcher by mutual nearest neighbors of MASt3R's descriptors at given keypoints."""

    network: ClassVar[Callable[..., PairNetwork]] = OnnxPairNetwork

    def __init__(self, options: SparseSearch, context: ProviderContext) -> None:
        self._network = self.network(options, context)
        self._min_similarity = options.min_similarity

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match keypoints by the mean descriptor similarity of both network passes."""
        features_a, features_b = require_features(
            "mast3r-sparse matches keypoints", features_a, features_b
        )
        passes = self._network.both(view_a, view_b)
        a, b = passes[0]
        cells_a, cells_b = a.cells(features_a.keypoints), b.cells(features_b.keypoints)
        rows_a, rows_b = np.flatnonzero(cells_a >= 0), np.flatnonzero(cells_b >= 0)
        cells_a, cells_b = cells_a[rows_a], cells_b[rows_b]
        similarity = np.mean(
            [a.descriptors[cells_a] @ b.descriptors[cells_b].T for a, b in passes], axis=0
        )
        pairs = find_mutual(similarity)
        pairs = pairs[similarity[pairs[:, 0], pairs[:, 1]] >= self._min_similarity]
        cells = np.stack([cells_a[pairs[:, 0]], cells_b[pairs[:, 1]]], axis=1)
        scores = np.max([_scores(a, b, cells) for a, b in passes], axis=0)
        indices = np.stack([rows_a[pairs[:, 0]], rows_b[pairs[:, 1]]], axis=1)
        return PairMatches(sparse=SparseMatches(indices, scores), depth=_depth(passes))


def _scores(a: ViewOutput, b: ViewOutput, cells: Int64) -> Float32:
    """Compute the scores (m,) in [0, 1) of matches from their descriptor indices (m, 2).

    The score is ``c / (1 + c)``, where c is the geometric mean of both descriptor confidences.
    """
    certainty = np.sqrt(a.match_certainty[cells[:, 0]] * b.match_certainty[cells[:, 1]])
    scores: Float32 = (certainty / (1 + certainty)).astype(np.float32)
    return scores


def _merge(pairs: Int64, scores: Float32) -> tuple[Int64, Float32]:
    """Merge duplicate matches (m, 2), and assign the largest of their scores."""
    order = np.argsort(-scores, kind="stable")
    unique, first = np.unique(pairs[order], axis=0, return_index=True)
    return unique, scores[order][first]


def _depth(
    passes: tuple[tuple[ViewOutput, ViewOutput], tuple[ViewOutput, ViewOutput]],
) -> PairDepth:
    """Return the depth of each view from the pass in which this view is the first one."""
    return PairDepth(passes[0][0].depth(), passes[1][1].depth())
