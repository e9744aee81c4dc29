"""Which verified pairs depth refutes (paper section 3.4, before anything else holds their images).

What looks alike matches in hundreds of points, and one pose explains them all: two ends of a table,
two rooms of one kind. But all that lies around them is seen too, and there a wrong pose puts
surfaces where the other view sees empty space. So each pair's pose is held against the depth of
both images, and where that contradicts it, the poses that its matches support less.

A pair without a pose that depth allows may still be right: few or bad matches turn it, and depth is
exact. What other pairs say tells. Where those that depth allows tie its images together by more
matches than it has, and turn them otherwise, the pair is refuted twice, and does not count. Of the
others the matches count as far as the best pose that depth allows is supported, in terms of the
best one of all. Pairs of fewer matches than an image needs to be registered decide nothing, and
are not asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow

from mpsfm_core.data import Bool, Float64, MappingProblem, VerifiedPair
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.consistency.depth_consistency import DepthConsistencyCheck
from mpsfm_core.mapping.initialization.global_initialization import (
    average_rotations,
    label_components,
)
from mpsfm_core.mapping.initialization.initial_pair import (
    InitialPair,
    estimate_pairs_from_depth,
    refine_initial_pairs,
    register_first_image,
    scale_verified_pair,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator

MAX_TURN_DEG = 30.0
"""Between what a pair says and what all others do, along a few links of some degrees (ours)."""


class PairConsistency(NamedTuple):
    """Of a pair. ``rotation`` (3, 3): ``b_from_a`` of the best pose that depth allows, or else of
    the best; ``share``: how well it is supported in terms of the best, 0 if none is allowed."""

    rotation: Float64
    share: float


class PairConsistencyCheck:
    """Holds the pairs of a scene without images against depth and against each other."""

    def __init__(self, search: AbsolutePoseEstimator, options: MapperOptions) -> None:
        self._search, self._scene, self._options = search, search.scene, options
        self._check = DepthConsistencyCheck(search.scene, options.consistency, fills_holes=True)

    def reweight_pairs(self, problem: MappingProblem, left: Bool) -> MappingProblem:
        """The problem with the matches of pairs as far as depth allows them, and without the pairs
        that depth and others refute; pairs of images that are not ``left`` (n,) stay as they are.
        """
        needed = self._options.registration.min_inliers
        verdicts = {
            pair: self.check_pair(pair)
            for pair in problem.pairs
            if len(pair) >= needed and left[pair.image_a] and left[pair.image_b]
        }
        sure = {p: v.rotation for p, v in verdicts.items() if v.share * len(p) >= needed}
        links, rotations = _turned(sure, len(problem.images))
        pairs = []
        for pair in problem.pairs:
            verdict = verdicts.get(pair, PairConsistency(pair.rotation, 1.0))
            if verdict.share > 0:
                pairs.append(_times(pair, verdict.share))
                continue
            a, b = pair.image_a, pair.image_b
            turn = rotation_angle_deg(rotations[b] @ rotations[a].T @ verdict.rotation.T)
            tied = maximum_flow(links, a, b).flow_value
            if tied <= len(pair) or turn <= MAX_TURN_DEG:
                pairs.append(pair)
        return replace(problem, pairs=tuple(pairs))

    def check_pair(self, pair: VerifiedPair) -> PairConsistency:
        """What depth says of a pair; where nothing gives a pose, it allows the verified one."""
        verified = scale_verified_pair(self._scene, pair, self._options.initialization)
        if verified is not None and self._allows(verified):
            return PairConsistency(pair.rotation, 1.0)
        search, options = self._search, self._options.registration
        found = estimate_pairs_from_depth(search, pair, options, rough=True)
        starts = [start for start in found if start.pose.support > 0]
        if not starts:
            return PairConsistency(pair.rotation, 1.0)
        allowed = self._best_allowed(starts)
        if allowed is None:
            starts = refine_initial_pairs(search, pair, starts, options)
            allowed = self._best_allowed(starts)
        best = max(starts, key=_support)
        if allowed is None:
            return PairConsistency(_b_from_a(pair, best), 0.0)
        return PairConsistency(_b_from_a(pair, allowed), _support(allowed) / _support(best))

    def _best_allowed(self, starts: Sequence[InitialPair]) -> InitialPair | None:
        """The best supported pose that depth allows, if there is one."""
        ranked = sorted(starts, key=_support, reverse=True)
        return next((start for start in ranked if self._allows(start)), None)

    def _allows(self, start: InitialPair) -> bool:
        """Whether depth does not contradict a pose."""
        scene, limit = self._scene, self._options.consistency.max_violations_pair
        empty = scene.snapshot()
        register_first_image(scene, start.reference)
        scale = self._scale_of(start)
        scene.register(start.image, start.pose.rotation, start.pose.translation)
        scene.maps[start.image].set_scale(scale)
        share = self._check.violation_ratio(start.reference, start.image, limit=limit)
        scene.restore(empty)
        return share <= limit

    def _scale_of(self, start: InitialPair) -> float:
        """Scale of the other image's depth that fits the first one's where they match."""
        scene, pose = self._scene, start.pose
        found = find_correspondences(
            scene, start.image, [start.reference], self._options.registration
        )
        depth_map = scene.maps[start.image]
        rows = found.keypoints - scene.graph.offsets[start.image]
        z = found.points @ pose.rotation[2] + pose.translation[2]
        use = found.known & depth_map.keypoint_valid[rows] & (z > 0)
        ratios = np.log(z[use] / depth_map.prior_at_keypoints(rows[use]))
        return float(np.exp(np.median(ratios))) if use.any() else 1.0


def _turned(turns: Mapping[VerifiedPair, Float64], count: int) -> tuple[csr_array, Float64]:
    """``(links, rotations)``: (count, count) matches by which pairs tie images together, and
    (count, 3, 3) how they are turned by what all pairs of a group say. ``turns``: ``b_from_a``
    (3, 3) of each pair."""
    a = np.array([pair.image_a for pair in turns], dtype=np.int64)
    b = np.array([pair.image_b for pair in turns], dtype=np.int64)
    weights = np.array([len(pair) for pair in turns], dtype=np.int32)
    said = np.array(list(turns.values())).reshape(-1, 3, 3)
    ways = np.concatenate([a, b]), np.concatenate([b, a])
    links = csr_array((np.tile(weights, 2), ways), shape=(count, count))
    group = label_components(a, b, count)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    for number in np.unique(group[a]):
        own = group[a] == number
        found = average_rotations(a[own], b[own], said[own], 1.0 * weights[own], count)
        rotations[group == number] = found[group == number]
    return links, rotations


def _support(start: InitialPair) -> float:
    return start.pose.support


def _b_from_a(pair: VerifiedPair, start: InitialPair) -> Float64:
    rotation = start.pose.rotation
    return rotation if start.reference == pair.image_a else rotation.T


def _times(pair: VerifiedPair, share: float) -> VerifiedPair:
    """The pair with scores that are so much less."""
    return pair if share == 1.0 else replace(pair, scores=pair.scores * np.float32(share))
