"""Depth consistency of verified pairs before registration (paper section 3.4).

Two look-alike places give hundreds of matches that one wrong relative pose explains. The
surroundings of look-alike places differ, so a wrong relative pose puts surfaces where the other
image sees empty space.

1. The relative pose of each verified pair is checked for depth consistency. If the relative pose of
   a pair is inconsistent, other pose hypotheses are checked in the order of their support.
2. The matches of a pair are weighted by the support of the best depth-consistent pose, relative to
   the best supported pose.
3. A pair without a depth-consistent pose may still be correct, if few or bad matches make its
   relative pose inaccurate. A pair without a depth-consistent pose is removed if consistent pairs
   connect its images by more matches (maximum flow) and imply another relative rotation.

Image pairs with fewer matches than a registration needs are not checked.
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
    find_short_cycle_edges,
    label_components,
)
from mpsfm_core.mapping.initialization.initial_pair import (
    InitialPair,
    estimate_initial_pairs,
    refine_initial_pairs,
    register_first_image,
    scale_verified_pair,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator

MAX_ROTATION_ERROR_DEG = 30.0
"""Maximum angle between the relative rotation of a pair and the relative rotation that
depth-consistent pairs imply, with a margin for errors of some degrees along a chain of pairs.
[ours]"""

MAX_VIOLATIONS = 0.01
"""Share of pixels with contradicting depth above which the relative pose of an image pair is
inconsistent, before any image is registered. [tuned: benchmarks.accuracy]"""


class PairConsistency(NamedTuple):
    """Result of the depth consistency check of one image pair."""

    rotation: Float64
    """(3, 3) rotation ``b_from_a`` of the best depth-consistent relative pose, or of the best
    supported pose if no pose is consistent."""
    support_ratio: float
    """Support of the best depth-consistent pose relative to the best supported pose, 0 if no pose
    is consistent."""


class PairConsistencyCheck:
    """Depth consistency check of the verified pairs of a scene without registered images."""

    def __init__(self, pose_estimator: AbsolutePoseEstimator, options: MapperOptions) -> None:
        self._pose_estimator, self._scene = pose_estimator, pose_estimator.scene
        self._options = options
        self._depth_check = DepthConsistencyCheck(
            pose_estimator.scene, options.consistency, fill_holes=True
        )

    def compute_pair_weights(self, problem: MappingProblem, candidates: Bool) -> Float64:
        """Weight the match scores of each pair by its depth consistency.

        Args:
            problem: The mapping problem.
            candidates: (n,) bool mask of the images whose pairs are checked.

        Returns:
            (p,) float64 weights of the image pairs in [0, 1], 1 for pairs that are not checked, and
            0 for pairs to remove.
        """
        min_matches = self._options.registration.min_inliers
        results = {
            pair: self.check_pair(pair)
            for pair in problem.pairs_between_frames()
            if len(pair) >= min_matches and candidates[pair.image_a] and candidates[pair.image_b]
        }
        consistent = {
            pair: result.rotation
            for pair, result in results.items()
            if result.support_ratio * len(pair) >= min_matches
        }
        match_graph, rotations = _average_consistent_pairs(consistent, len(problem.images))
        weights = np.ones(len(problem.pairs))
        for row, pair in enumerate(problem.pairs):
            result = results.get(pair, PairConsistency(pair.rotation, 1.0))
            if result.support_ratio > 0:
                weights[row] = result.support_ratio
                continue
            a, b = pair.image_a, pair.image_b
            error_deg = rotation_angle_deg(rotations[b] @ rotations[a].T @ result.rotation.T)
            num_connecting = maximum_flow(match_graph, a, b).flow_value
            if num_connecting > len(pair) and error_deg > MAX_ROTATION_ERROR_DEG:
                weights[row] = 0.0
        return weights

    def check_pair(self, pair: VerifiedPair) -> PairConsistency:
        """Check the depth consistency of the relative pose of an image pair."""
        verified = scale_verified_pair(self._scene, pair)
        if verified is not None and self._is_consistent(verified):
            return PairConsistency(pair.rotation, 1.0)
        pose_estimator, options = self._pose_estimator, self._options.registration
        hypotheses = [
            initial
            for initial in estimate_initial_pairs(pose_estimator, pair, options, refine=False)
            if initial.pose.support > 0
        ]
        if not hypotheses:
            return PairConsistency(pair.rotation, 1.0)
        consistent = self._find_best_consistent(hypotheses)
        if consistent is None:
            hypotheses = refine_initial_pairs(pose_estimator, pair, hypotheses, options)
            consistent = self._find_best_consistent(hypotheses)
        best = max(hypotheses, key=_get_support)
        if consistent is None:
            return PairConsistency(_b_from_a(pair, best), 0.0)
        support_ratio = _get_support(consistent) / _get_support(best)
        return PairConsistency(_b_from_a(pair, consistent), support_ratio)

    def _find_best_consistent(self, hypotheses: Sequence[InitialPair]) -> InitialPair | None:
        """Return the best supported relative pose that passes the depth check, or None."""
        ranked = sorted(hypotheses, key=_get_support, reverse=True)
        return next((initial for initial in ranked if self._is_consistent(initial)), None)

    def _is_consistent(self, initial: InitialPair) -> bool:
        """Return True if a relative pose passes the depth consistency check."""
        scene, limit = self._scene, MAX_VIOLATIONS
        empty = scene.snapshot()
        register_first_image(scene, initial.reference)
        scale = self._estimate_scale(initial)
        scene.register(initial.image, initial.pose.rotation, initial.pose.translation)
        scene.maps[initial.image].set_scale(scale)
        ratio = self._depth_check.measure_violation_ratio(
            initial.reference, initial.image, limit=limit
        )
        scene.restore(empty)
        return ratio <= limit

    def _estimate_scale(self, initial: InitialPair) -> float:
        """Estimate the depth scale of the second image of a pair from matched keypoints."""
        scene, pose = self._scene, initial.pose
        correspondences = find_correspondences(
            scene, initial.image, [initial.reference], self._options.registration
        )
        depth_map = scene.maps[initial.image]
        of_image = scene.graph.image_of[correspondences.keypoints] == initial.image
        correspondences = correspondences.select(of_image)
        rows = correspondences.keypoints - scene.graph.offsets[initial.image]
        z = correspondences.points @ pose.rotation[2] + pose.translation[2]
        usable = correspondences.depth_known & depth_map.keypoint_valid[rows] & (z > 0)
        log_ratios = np.log(z[usable] / depth_map.prior_at_keypoints(rows[usable]))
        return float(np.exp(np.median(log_ratios))) if usable.any() else 1.0


def _average_consistent_pairs(
    rotation_of: Mapping[VerifiedPair, Float64], num_images: int
) -> tuple[csr_array, Float64]:
    """Build the match graph of depth-consistent pairs, and average their relative rotations.

    Args:
        rotation_of: Relative rotation ``b_from_a`` (3, 3) of each consistent pair.
        num_images: Number of images.

    Returns:
        Sparse matrix (n, n) with the number of matches of each two images, and rotations (n, 3, 3)
        of the images, in one world frame for each connected component.
    """
    a = np.array([pair.image_a for pair in rotation_of], dtype=np.int64)
    b = np.array([pair.image_b for pair in rotation_of], dtype=np.int64)
    weights = np.array([len(pair) for pair in rotation_of], dtype=np.int32)
    b_from_a = np.array(list(rotation_of.values())).reshape(-1, 3, 3)
    directed_edges = np.concatenate([a, b]), np.concatenate([b, a])
    match_graph = csr_array((np.tile(weights, 2), directed_edges), shape=(num_images, num_images))
    label = label_components(a, b, num_images)
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    for component in np.unique(label[a]):
        rows = label[a] == component
        edges = a[rows], b[rows]
        is_confirmed = find_short_cycle_edges(*edges, num_images)
        averaged = average_rotations(
            *edges, b_from_a[rows], 1.0 * weights[rows], num_images, is_confirmed
        )
        rotations[label == component] = averaged[label == component]
    return match_graph, rotations


def _get_support(initial: InitialPair) -> float:
    return initial.pose.support


def _b_from_a(pair: VerifiedPair, initial: InitialPair) -> Float64:
    rotation = initial.pose.rotation
    return rotation if initial.reference == pair.image_a else rotation.T


def reweight_pairs(problem: MappingProblem, weights: Float64) -> MappingProblem:
    """Return the problem with the match scores of each pair multiplied by a weight.

    Args:
        problem: The mapping problem.
        weights: (p,) float64 weight of each pair in [0, 1], where 0 removes the pair.
    """
    pairs = (
        pair if weight == 1.0 else replace(pair, scores=pair.scores * np.float32(weight))
        for pair, weight in zip(problem.pairs, weights, strict=True)
        if weight > 0
    )
    return replace(problem, pairs=tuple(pairs))
