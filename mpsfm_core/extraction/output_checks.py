"""Checks of a whole run for errors of the features provider and the matcher."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from mpsfm_core.data import Bool, DenseMatches, Float32, Float64, PinholeCamera
from mpsfm_core.data.decisions import DoubtReason, Reason
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.match_graph import MatchGraph

_MIN_IMAGES = 3
_MIN_KEYPOINTS = 50
_MAX_EXTENT = 0.8
"""Maximum right and lower end of all keypoints, relative to image size, that causes a doubt."""
_MAX_MARGIN = 0.1
"""Maximum left and upper margin of the keypoints, relative to image size, that causes a doubt.
An object in the image center has a larger margin, and therefore causes no doubt."""
_MIN_MATCHES = 1000
"""Minimum number of matches in all pairs from which unrelated scores cause a doubt. The correlation
of the scores of neighboring matches is 0 with a std of 0.023 if 1000 scores are random."""
_NUM_NEIGHBORS = 3
"""Number of nearest matches whose scores are compared with the score of a match."""
_SIGNIFICANT_STDS = 3.0
"""Number of standard deviations from 0 above which a correlation is no coincidence."""
_MAX_PAIRS = 1000
"""Maximum number of pairs whose scores are checked, evenly distributed over all pairs. [ours]"""
_MAX_COMPARED = 5000
"""Maximum number of matches of a pair that are compared with their nearest matches."""
_MAX_DENSE_PAIRS = 20
"""Maximum number of pairs of which all dense matches are read from the cache."""
_NUM_BLOCKS = 4
"""Number of rows and columns of blocks in an image whose outliers are not independent. AdaLAM gives
all matches of a neighborhood similar scores."""
_MIN_CORRELATION = 0.08
"""Smallest correlation of meaningful scores. The scores of neighboring matches have correlations
from 0.12 (mutual nearest neighbors of XFeat) to 0.7."""


@dataclass(frozen=True, eq=False)
class ScoredMatches:
    """Matches of a verified image pair, with the result of two-view verification."""

    xy: Float64
    """(m, 2) matched points in the first image, pixels."""
    scores: Float32
    """(m,) scores of the matches."""
    inlier: Bool
    """(m,) mask of the inliers."""
    dense: DenseMatches | None = None
    """All dense matches of the pair, from which the matches were selected by their scores."""


def find_wrong_providers(context: ExtractionContext, graph: MatchGraph) -> tuple[Reason, ...]:
    """Return reasons to doubt a features provider or matcher that is wrong for all images.

    Args:
        context: Context of the extraction that computed the match graph.
        graph: Keypoints, matches and two-view geometries.
    """
    config, doubts = context.config, []
    if config.features is not None:
        keypoints, cameras = graph.assembled.keypoints, [im.pinhole for im in context.images]
        doubts.append(find_partial_coverage(keypoints, cameras, config.features.use))
    matchers = [m for m in (config.matcher, config.dense_matcher) if m is not None]
    for matcher in matchers:
        is_dense, is_only = matcher is config.dense_matcher, len(matchers) == 1
        pairs = list(_scored_matches(graph, is_dense=is_dense, is_only=is_only))
        doubts.append(find_meaningless_scores(pairs, matcher.use))
    return tuple(doubt for doubt in doubts if doubt is not None)


def _scored_matches(graph: MatchGraph, *, is_dense: bool, is_only: bool) -> Iterator[ScoredMatches]:
    """Yield the matches of one matcher in each verified pair, or in ``_MAX_PAIRS`` of them.

    Args:
        graph: Matches and two-view geometries.
        is_dense: True for a dense matcher.
        is_only: True if the run has no other matcher.
    """
    outcomes = zip(graph.candidates, graph.geometries, strict=True)
    verified = [outcome for outcome in outcomes if not outcome[1].dropped]
    verified = verified[:: max(1, -(-len(verified) // _MAX_PAIRS))]
    reads_dense = is_dense and graph.matcher is not None and graph.matcher.keeps_results
    for number, (matches, geometry) in enumerate(verified):
        keypoints = graph.assembled.keypoints[matches.pair[0]][matches.sparse.indices[:, 0]]
        xy = np.concatenate([keypoints, matches.points.xy_a])
        scores = np.concatenate([matches.sparse.scores, matches.points.scores])
        inlier = np.zeros(len(scores), np.bool_)
        inlier[geometry.inliers] = True
        middle = len(matches.sparse)
        rows = slice(None)
        if not is_only:
            rows = slice(middle, None) if is_dense else slice(middle)
        dense = None
        if reads_dense and number < _MAX_DENSE_PAIRS:
            assert graph.matcher is not None
            results = graph.matcher.results(matches.pair)
            dense = next((r.dense for r in results if r.dense is not None), None)
        yield ScoredMatches(xy[rows], scores[rows], inlier[rows], dense)


def find_partial_coverage(
    keypoints: Sequence[Float64], cameras: Sequence[PinholeCamera], provider: str
) -> Reason | None:
    """Find out whether keypoints cover only the upper left part of every image.

    A wrong provider returns keypoints in pixels of a reduced or cropped image, or only of the first
    tile of an image. Keypoints in wrong pixels give wrong poses of all images.

    Args:
        keypoints: Keypoints (n, 2) of each image, pixels.
        cameras: Camera of each image.
        provider: Name of the features provider.

    Returns:
        Reason (``DoubtReason``) to doubt the run, or None.
    """
    extents = [
        np.stack([xy.min(axis=0), xy.max(axis=0)]) / camera.size
        for xy, camera in zip(keypoints, cameras, strict=True)
        if len(xy) >= _MIN_KEYPOINTS
    ]
    if len(extents) < _MIN_IMAGES:
        return None
    first, last = np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]
    if first.max() > _MAX_MARGIN or last.max() > _MAX_EXTENT:
        return None
    return DoubtReason.PARTIAL_COVERAGE.because(
        provider=provider,
        num_images=len(extents),
        width_ratio=round(float(last[0]), 3),
        height_ratio=round(float(last[1]), 3),
    )


def find_meaningless_scores(pairs: Sequence[ScoredMatches], provider: str) -> Reason | None:
    """Find out whether the scores of matches are inverted or unrelated to the matches.

    Best scores select matches of a keypoint and points of dense matches, so inverted scores select
    outliers. Two rank correlations are computed in each pair and averaged over all pairs:

    * between score and inlier (rank-biserial correlation, Cureton 1956), which is negative for
      inverted scores;
    * between the scores of neighboring matches. Texture, blur and perspective are similar at
      neighboring points, so meaningful scores are similar. This correlation needs no outliers.

    Scores are meaningless if both correlations are 0 within the limits of chance. Only the second
    one counts for dense matches. Equal scores of all matches cause no doubt.

    Args:
        pairs: Matches of each verified pair.
        provider: Name of the matcher.

    Returns:
        Reason (``DoubtReason``) to doubt the run, or None.
    """
    compared = [pair for pair in pairs if len(pair.scores) > 1 and np.ptp(pair.scores) > 0]
    with_inlier, with_neighbor = _correlate_with_inlier(compared), _correlate_neighbors(compared)
    # The best of several random scores of a dense matcher are also higher for inliers.
    is_selected = any(pair.dense is not None for pair in compared)
    is_related = with_neighbor.strength > 1 or (with_inlier.strength > 1 and not is_selected)
    is_undecided = sum(len(pair.scores) for pair in compared) < _MIN_MATCHES
    if with_inlier.strength >= -1 and (is_related or is_undecided):
        return None
    return DoubtReason.MEANINGLESS_SCORES.because(provider=provider, num_pairs=len(compared))


class _Correlation(NamedTuple):
    """Correlation averaged over all pairs, and the std that it has for random scores."""

    value: float
    std: float

    @property
    def strength(self) -> float:
        """Correlation divided by the largest correlation of random scores."""
        return self.value / max(_MIN_CORRELATION, _SIGNIFICANT_STDS * self.std)


_UNKNOWN = _Correlation(0.0, np.inf)


def _correlate_with_inlier(pairs: Sequence[ScoredMatches]) -> _Correlation:
    """Correlate scores and inliers, with the number of outliers as weight of a pair.

    Neighboring outliers have similar scores, so the outliers in a block of an image count as one
    observation for the standard deviation.
    """
    sums: list[Float64] = []
    num_outliers = 0
    for pair in pairs:
        inliers = np.sort(pair.scores[pair.inlier])
        outliers = pair.scores[~pair.inlier]
        if not (len(inliers) and len(outliers)):
            continue
        num_lower, num_equal_or_lower = (
            np.searchsorted(inliers, outliers, side) for side in ("left", "right")
        )
        order = 1 - (num_lower + num_equal_or_lower) / len(inliers)
        low, size = pair.xy.min(axis=0), np.maximum(np.ptp(pair.xy, axis=0), 1)
        blocks = np.floor(_NUM_BLOCKS * (pair.xy[~pair.inlier] - low) / size)
        block = np.unique(blocks, axis=0, return_inverse=True)[1]
        sums.append(np.bincount(block, order).astype(np.float64))
        num_outliers += len(outliers)
    if not num_outliers:
        return _UNKNOWN
    total = np.concatenate(sums)
    return _Correlation(total.sum() / num_outliers, float(np.linalg.norm(total)) / num_outliers)


def _correlate_neighbors(pairs: Sequence[ScoredMatches]) -> _Correlation:
    """Correlate the score ranks of each match and of its nearest matches in the first image.

    The number of matches is the weight of a pair. For random scores, only the products of matches
    that are among the nearest of each other are equal, which gives the variance. All dense matches
    are compared, because the best of several random scores is higher where matches are dense.
    """
    total, variance, num_products = 0.0, 0, 0
    for pair in pairs:
        xy, scores = pair.xy, pair.scores
        if pair.dense is not None:
            xy, scores = pair.dense.points_a, pair.dense.scores
        count = len(scores)
        some = np.unique(np.linspace(0, count - 1, _MAX_COMPARED).astype(np.int64))
        nearest = cKDTree(xy).query(xy[some], k=min(_NUM_NEIGHBORS + 1, count))[1]
        rows, columns = np.repeat(some, nearest.shape[1]), nearest.ravel()
        # The nearest match of most matches is the match itself.
        rows, columns = rows[rows != columns], columns[rows != columns]
        ranks = rankdata(scores)
        ranks = (ranks - ranks.mean()) / ranks.std()
        # Drawing without replacement gives ranks of two matches a correlation of -1 / (count - 1).
        total += float(ranks[rows] @ ranks[columns]) + len(rows) / (count - 1)
        is_mutual = np.isin(columns * count + rows, rows * count + columns)
        variance += len(rows) + int(is_mutual.sum())
        num_products += len(rows)
    if not num_products:
        return _UNKNOWN
    return _Correlation(total / num_products, float(np.sqrt(variance)) / num_products)
