"""Matching and verification of image pairs, and assembly of their keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import numpy as np
import pycolmap

from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    Float64,
    MappingImage,
    MappingProblem,
    PairMatches,
    SparseMatches,
    VerifiedPair,
)
from mpsfm_core.data.errors import ProviderRunError
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.cache import content_key, digest
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.empty_results import EMPTY_RESULTS
from mpsfm_core.extraction.features import FeatureSource
from mpsfm_core.extraction.matching.dense_matches import (
    NO_POINTS,
    PointMatches,
    sample_dense_matches,
    snap_to_keypoints,
)
from mpsfm_core.extraction.matching.keypoint_adjustment import (
    ADJUSTED_STD_RATIO,
    KeypointAdjuster,
)
from mpsfm_core.extraction.matching.verification import CALIBRATED, TwoViewGeometry, verify_matches
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.geometry.two_view import estimate_two_view_geometry
from mpsfm_core.providers.kinds.matcher import run_matcher
from mpsfm_core.providers.source_hash import hash_module


@dataclass(frozen=True, eq=False)
class CandidateMatches:
    """Matches of an image pair before two-view verification."""

    pair: Pair
    sparse: SparseMatches
    """Matches between detected keypoints."""
    points: PointMatches
    """Matches sampled from dense matches, which are numbered after the matches in ``sparse``."""
    std_px: float
    """Standard deviation of the sampled ``points``, pixels."""
    precision: tuple[float, float] = (0.0, 0.0)
    """Mean inverse variance of the depth that the matcher predicts per image, 0 without depth."""

    def __len__(self) -> int:
        return len(self.sparse) + len(self.points.scores)


LocatedFeatures = Sequence[Features] | FeatureSource
"""Features of each image by image index, whose descriptors may be empty."""


class PairMatcher:
    """Runs the configured matchers on pairs of images."""

    def __init__(self, context: ExtractionContext, table: FeatureSource | None) -> None:
        self._context = context
        self._table = table
        config = context.config
        chosen = (config.matcher, config.dense_matcher)
        self._providers = [context.provider("matcher", b) for b in chosen if b is not None]
        self._snaps = config.matcher is None and table is not None

    def match(self, pairs: list[Pair], located: list[Features]) -> list[CandidateMatches]:
        """Match image pairs with the features of all images, whose descriptors may be empty.

        Raises:
            ProviderRunError: a matcher failed, or skipped failures exceed half of the pairs.
        """

        def work(pair: Pair) -> CandidateMatches:
            return self.match_pair(pair, located)

        matches = self._context.each("matching", pairs, work, *self._providers)
        failures = [text for p in pairs if (text := self._context.pair_failures.get(p))]
        if len(failures) > len(pairs) / 2:
            raise ProviderRunError(
                f"matchers failed on {len(failures)} of {len(pairs)} pairs, most recently with: "
                f"{failures[-1]}"
            )
        return matches

    def results(self, pair: Pair) -> list[PairMatches]:
        """Return the cached or computed results of all matchers for an image pair."""
        return [self._run(provider, pair) for provider in self._providers]

    def pair_depth(self, pair: Pair, side: int) -> DepthPrior:
        """Return the depth that a matcher predicts for one image (0 or 1) of a pair."""
        for provider in self._providers:
            depth = self._run(provider, pair).depth
            if depth is not None:
                return (depth.depth_a, depth.depth_b)[side]
        raise LookupError(f"no matcher predicts depth for pair {pair}")

    @property
    def is_cached(self) -> bool:
        """True if all results of the matchers are in the cache."""
        return all(provider.is_cached for provider in self._providers)

    @property
    def keeps_results(self) -> bool:
        """True if the results of all matchers are cached, at least until the run ends."""
        return not any(provider.can("uncached") for provider in self._providers)

    def match_pair(self, pair: Pair, located: LocatedFeatures) -> CandidateMatches:
        """Match an image pair with the features of all images, whose descriptors may be empty."""
        a, b = located[pair[0]], located[pair[1]]
        options = self._context.config.extraction
        results = self.results(pair)
        no_scores = np.empty(0, dtype=np.float32)
        sparse = SparseMatches(np.empty((0, 2), dtype=np.int64), no_scores)
        points, std_px = NO_POINTS, 1.0
        for result in results:
            if result.sparse is not None:
                sparse = result.sparse
            if result.dense is None:
                continue
            dense = self._unmasked(pair, result.dense)
            if self._snaps:
                sparse = snap_to_keypoints(dense, a.keypoints, b.keypoints, options.dense_snap_px)
            points = sample_dense_matches(dense, a.keypoints, b.keypoints)
            std_px = dense.std_px
        return CandidateMatches(pair, sparse, points, std_px, _precision(results))

    def _run(self, provider: ActiveProvider, pair: Pair) -> PairMatches:
        context, table = self._context, self._table
        if context.failed(pair):
            return cast(PairMatches, EMPTY_RESULTS[PairMatches]())

        def compute(instance: Any) -> PairMatches:
            # Matchers of features do not use the pixels of the views.
            views = context.view_on_demand(pair[0]), context.view_on_demand(pair[1])
            features = None if table is None else (table[pair[0]], table[pair[1]])
            return run_matcher(provider.spec, instance, views, features)

        inputs: list[object] = [context.view_inputs(index, provider) for index in pair]
        if table is not None and provider.can("sparse"):
            inputs += [table.key(index) for index in pair]
        return context.result(provider, PairMatches, inputs, compute, pair)

    def _unmasked(self, pair: Pair, dense: DenseMatches) -> DenseMatches:
        """Remove dense matches with a point in a masked area."""
        keep = np.ones(len(dense), dtype=np.bool_)
        for index, points in zip(pair, (dense.points_a, dense.points_b), strict=True):
            mask = self._context.mask(index)
            if mask is not None:
                keep &= sample_nearest(mask, points)
        return DenseMatches(
            dense.points_a[keep], dense.points_b[keep], dense.scores[keep], dense.std_px
        )


class PairVerifier:
    """Estimates the two-view geometry of candidate matches and caches the results.

    Args:
        context: Context of the extraction with images, options and cache.
        located: Features of each image, whose descriptors may be empty.
        matcher: Matcher of the candidate matches, whose results remote workers read from the cache,
            or None for imported matches.
    """

    def __init__(
        self,
        context: ExtractionContext,
        located: LocatedFeatures,
        matcher: PairMatcher | None = None,
    ) -> None:
        self._context, self._located, self._matcher = context, located, matcher

    def verify(self, candidates: list[CandidateMatches]) -> list[TwoViewGeometry]:
        """Verify the candidate matches of all pairs; return their two-view geometries in order."""
        is_cached = self._matcher is not None and self._matcher.is_cached
        pairs = [matches.pair for matches in candidates] if is_cached else None
        return self._context.each("verification", candidates, self._verify, remote_items=pairs)

    def verify_pair(self, pair: Pair) -> TwoViewGeometry:
        """Verify the matches of an image pair that the matcher has cached."""
        assert self._matcher is not None
        return self._verify(self._matcher.match_pair(pair, self._located))

    def _verify(self, matches: CandidateMatches) -> TwoViewGeometry:
        options, seed = self._context.config.verification, self._context.config.runtime.seed
        a, b = matches.pair
        rows = matches.sparse.indices
        xy_a = np.concatenate([self._located[a].keypoints[rows[:, 0]], matches.points.xy_a])
        xy_b = np.concatenate([self._located[b].keypoints[rows[:, 1]], matches.points.xy_b])
        std_px = max(
            max(self._located[a].std_px, self._located[b].std_px) if len(rows) else 0.0,
            matches.std_px if len(matches.points.scores) else 0.0,
        )
        cameras = self._context.images[a].pinhole, self._context.images[b].pinhole
        parts = [
            options.model_dump(mode="json"),
            *map(asdict, cameras),
            std_px,
            seed,
            pycolmap.__version__,
            *(hash_module(f.__module__) for f in (verify_matches, estimate_two_view_geometry)),
        ]
        key = content_key(parts, digest(xy_a), digest(xy_b))
        found = self._context.cache.load("two-view", key, TwoViewGeometry)
        if found is None:
            found = verify_matches(*cameras, xy_a, xy_b, options, std_px=std_px, seed=seed)
            self._context.cache.store("two-view", key, found)
        return found


@dataclass(frozen=True, eq=False)
class AssembledMatches:
    """Verified image pairs, and the keypoints of all images."""

    pairs: tuple[VerifiedPair, ...]
    keypoints: list[Float64]
    """(n, 2) keypoints of each image, pixels."""
    std_px: list[float]
    """Median standard deviation of the detected keypoints of each image, pixels."""
    std_factor: list[Float64]
    """(n,) ratio of each keypoint's standard deviation to ``std_px``, less than 1 if adjusted."""


def assemble_matches(
    candidates: list[CandidateMatches], outcomes: list[TwoViewGeometry], located: list[Features]
) -> AssembledMatches:
    """Collect the features of each image, and the sampled points of its verified pairs."""
    keypoints = [[features.keypoints] for features in located]
    counts = [len(features) for features in located]
    noise = [[(len(features), features.std_px)] for features in located]
    verified = []
    for matches, outcome in zip(candidates, outcomes, strict=True):
        if outcome.dropped:
            continue
        sparse = outcome.inliers[outcome.inliers < len(matches.sparse)]
        free = outcome.inliers[outcome.inliers >= len(matches.sparse)] - len(matches.sparse)
        columns = []
        for side, image in enumerate(matches.pair):
            points = (matches.points.xy_a, matches.points.xy_b)[side][free]
            new_rows = counts[image] + np.arange(len(points), dtype=np.int64)
            columns.append(np.concatenate([matches.sparse.indices[sparse, side], new_rows]))
            keypoints[image].append(points)
            counts[image] += len(points)
            noise[image].append((len(points), matches.std_px))
        verified.append(
            VerifiedPair(
                *matches.pair,
                np.stack(columns, axis=1),
                np.concatenate([matches.sparse.scores[sparse], matches.points.scores[free]]),
                outcome.rotation,
                outcome.translation,
                outcome.configuration == CALIBRATED,
            )
        )
    return AssembledMatches(
        tuple(verified),
        [np.concatenate(parts) for parts in keypoints],
        [_median_std(parts) for parts in noise],
        [np.ones(count) for count in counts],
    )


def add_duplicates(assembled: AssembledMatches, originals: Mapping[int, int]) -> AssembledMatches:
    """Give duplicates the keypoints of their originals, and a verified pair with all keypoints.

    Args:
        assembled: Verified pairs and keypoints of the originals.
        originals: Index of the original image by index of the duplicate.
    """
    source = [originals.get(image, image) for image in range(len(assembled.keypoints))]
    pairs = list(assembled.pairs)
    for duplicate, original in originals.items():
        rows = np.arange(len(assembled.keypoints[original]), dtype=np.int64)
        matches, scores = np.stack([rows, rows], axis=1), np.ones(len(rows), np.float32)
        pairs.append(
            VerifiedPair(original, duplicate, matches, scores, np.eye(3), np.zeros(3), False)
        )
    return AssembledMatches(
        tuple(sorted(pairs, key=lambda pair: (pair.image_a, pair.image_b))),
        [assembled.keypoints[image] for image in source],
        [assembled.std_px[image] for image in source],
        [assembled.std_factor[image] for image in source],
    )


def adjust_assembled(context: ExtractionContext, assembled: AssembledMatches) -> AssembledMatches:
    """Adjust the keypoints of all verified matches, if keypoint adjustment is enabled."""
    options = context.config.adjustment
    if not (options.enabled and assembled.pairs):
        return assembled
    adjuster = KeypointAdjuster(context, assembled.keypoints, assembled.std_px)
    adjusted = adjuster.run(assembled.pairs)
    return replace(
        assembled,
        keypoints=[image.keypoints for image in adjusted],
        std_factor=[np.where(image.measured, ADJUSTED_STD_RATIO, 1.0) for image in adjusted],
    )


def adjust_problem_keypoints(context: ExtractionContext, problem: MappingProblem) -> MappingProblem:
    """Adjust the keypoints of a mapping problem that has detected keypoints."""
    images = problem.images
    distinct = AssembledMatches(
        problem.distinct_pairs,
        [image.keypoints for image in images],
        [image.keypoint_std_px for image in images],
        [_std_factor(image) for image in images],
    )
    found = add_duplicates(adjust_assembled(context, distinct), problem.originals)
    moved = (
        replace(image, keypoints=keypoints, keypoint_std_factor=factor)
        for image, keypoints, factor in zip(images, found.keypoints, found.std_factor, strict=True)
    )
    return replace(problem, images=tuple(moved))


def merge_matches(problem: MappingProblem, more: AssembledMatches) -> MappingProblem:
    """Add verified matches to a mapping problem, and append their new keypoints."""
    offsets = [len(image.keypoints) for image in problem.images]
    images = tuple(
        replace(
            image,
            keypoints=np.concatenate([image.keypoints, xy]),
            keypoint_std_px=_median_std(
                [(len(image.keypoints), image.keypoint_std_px), (len(xy), std)]
            ),
            keypoint_std_factor=np.concatenate([_std_factor(image), factor]),
        )
        for image, xy, std, factor in zip(
            problem.images, more.keypoints, more.std_px, more.std_factor, strict=True
        )
    )
    pairs = {(pair.image_a, pair.image_b): pair for pair in problem.pairs}
    for pair in more.pairs:
        key = pair.image_a, pair.image_b
        rows = pair.matches + np.array([offsets[index] for index in key])
        pairs[key] = _merge_pair(pairs.get(key), replace(pair, matches=rows))
    return replace(problem, images=images, pairs=tuple(pairs[key] for key in sorted(pairs)))


def _std_factor(image: MappingImage) -> Float64:
    factor = image.keypoint_std_factor
    return np.ones(len(image.keypoints)) if factor is None else factor


def _merge_pair(a: VerifiedPair | None, b: VerifiedPair) -> VerifiedPair:
    """Concatenate two lists of verified matches of a pair; use the pose with more inliers."""
    if a is None:
        return b
    return replace(
        max(a, b, key=len),
        matches=np.concatenate([a.matches, b.matches]),
        scores=np.concatenate([a.scores, b.scores]),
    )


def _median_std(parts: list[tuple[int, float]]) -> float:
    """Return the median std of keypoints, given as tuples (number of keypoints, std)."""
    values = np.repeat([std for _, std in parts], [count for count, _ in parts])
    return float(np.median(values)) if len(values) else 1.0


def _precision(results: list[PairMatches]) -> tuple[float, float]:
    for result in results:
        if result.depth is not None:
            return _mean_precision(result.depth.depth_a), _mean_precision(result.depth.depth_b)
    return 0.0, 0.0


def _mean_precision(depth: DepthPrior) -> float:
    """Return the mean inverse variance of valid depths, to rank image pairs [reference]."""
    if depth.variance is None or not depth.valid.any():
        return 0.0
    return float((1.0 / depth.variance[depth.valid].astype(np.float64)).mean())
