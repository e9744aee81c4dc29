"""How much the matches of a new image support a pose, and the pose nearby that they support most.

A match supports a pose if its keypoint lies near the segment onto which the other keypoint's ray
projects between the depths that the prior allows, and if the depth that follows fits the new
image's own prior. Where the other depth is unknown, the segment is all of the ray that may be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Bool, Float64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesis
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.optimize.resection import Segments, distances_and_depths, refine_pose

REFINEMENT_SCALES = np.maximum(5.0 * 0.8 ** np.arange(12), 1.0)
"""Of the limit up to which a match counts, from one step to the next: a pose of RANSAC from lifted
points may be off by pixels first (ours)."""


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """``cam_from_world``, its source, and the support of the reference image with most of it.

    ``support`` is the truncated quadratic score (MSAC) by which hypotheses are compared, in terms
    of the matches' weights, as is ``inlier_ratio``; ``num_inliers`` counts what they are worth.
    """

    rotation: Float64
    translation: Float64
    source: str
    support: float
    num_inliers: int
    inlier_ratio: float

    @property
    def hypothesis(self) -> PoseHypothesis:
        """The pose alone, to be rated again."""
        return PoseHypothesis(self.rotation, self.translation, self.source)


def score_pose(
    scene: Scene,
    found: PoseCorrespondences,
    hypothesis: PoseHypothesis,
    options: RegistrationOptions,
) -> ScoredPose:
    """A pose with the support that the correspondences give it."""
    misfit = _misfits(scene, found, hypothesis, options)
    inlier = misfit < 1

    def per_reference(values: Float64) -> Float64:
        sums = np.bincount(found.references, values, minlength=scene.num_images)
        return sums.astype(np.float64)

    support = per_reference(found.weights * (1 - misfit**2))
    best = int(np.argmax(support))
    total = per_reference(found.weights)[best]
    return ScoredPose(
        *hypothesis,
        float(support[best]),
        int(per_reference(found.depth_weights * inlier)[best]),
        float(per_reference(found.weights * inlier)[best] / total) if total else 0.0,
    )


def maximize_support(
    scene: Scene, found: PoseCorrespondences, pose: ScoredPose, options: RegistrationOptions
) -> ScoredPose:
    """The pose nearby at which keypoints lie nearest to their segments, rated."""
    if not len(found.keypoints):
        return pose
    rotation, translation = refine_pose(
        (pose.rotation, pose.translation),
        _intrinsics(scene, found),
        _segments(scene, found, options),
        scales=REFINEMENT_SCALES,
    )
    return score_pose(scene, found, PoseHypothesis(rotation, translation, pose.source), options)


def _intrinsics(scene: Scene, found: PoseCorrespondences) -> Float64:
    """fx, fy, cx, cy of the image that the keypoints are of."""
    intrinsics: Float64 = scene.intrinsics[scene.graph.image_of[found.keypoints[0]]]
    return intrinsics


def _segments(scene: Scene, found: PoseCorrespondences, options: RegistrationOptions) -> Segments:
    std = scene.keypoint_std_px[scene.graph.image_of[found.keypoints]]
    return Segments(
        near=found.near,
        far=found.far,
        xy=scene.keypoints[found.keypoints],
        limit=options.max_support_error_px * std,
        weight=found.weights,
    )


def _misfits(
    scene: Scene,
    found: PoseCorrespondences,
    pose: PoseHypothesis,
    options: RegistrationOptions,
) -> Float64:
    """(m,) how far each match is from supporting a pose, in terms of the limits; at most 1."""
    if not len(found.keypoints):
        return np.empty(0)
    segments = _segments(scene, found, options)
    distance, depth = distances_and_depths(
        (pose.rotation, pose.translation), _intrinsics(scene, found), segments
    )
    misfits = distance / segments.limit
    misfits = np.fmax(misfits, _depth_misfits(scene, found, depth, misfits < 1, options))
    return np.where(misfits < 1, misfits, 1.0)


def _depth_misfits(
    scene: Scene,
    found: PoseCorrespondences,
    depth: Float64,
    near: Bool,
    options: RegistrationOptions,
) -> Float64:
    """(m,) how far depths in the new image are from its prior, up to one scale; NaN: unknown."""
    misfits = np.full(len(depth), np.nan)
    image = int(scene.graph.image_of[found.keypoints[0]])
    rows = found.keypoints - scene.graph.offsets[image]
    known = found.known & scene.maps[image].keypoint_valid[rows] & (depth > 0)
    if (known & near).any():
        log_ratio = np.log(depth[known] / scene.maps[image].prior_at_keypoints(rows[known]))
        own = scene.keypoint_log_std[found.keypoints[known]]
        other = scene.keypoint_log_std[found.matched[known]]
        limit = options.depth_deviations * np.hypot(own, other)
        misfits[known] = np.abs(log_ratio - np.median(log_ratio[near[known]])) / limit
    return misfits
