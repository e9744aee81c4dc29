"""Selection and relative pose of the initial image pair (paper section 3.1).

If keypoints of the first image are lifted to 3D points by the depth prior, the second image is
registered to these points by PnP. Otherwise, the relative pose is that of geometric verification,
and the length of its baseline follows from the depth priors at the matches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason, reason_from_json
from mpsfm_core.geometry import triangulation_angle_deg
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.registration.rig_scale import estimate_rig_scale, set_frame_scales
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.mapping.triangulation import triangulate_midpoints

MAX_PAIRS = 50
"""Maximum number of initial image pairs to try. [ours]"""
NUM_COMPARED = 5
"""Number of image pairs with most matches whose relative poses are compared; the pair with the best
supported pose is tried first. [tuned: benchmarks.accuracy]"""
MIN_ANGLE_DEG = 1.5
"""Smallest triangulation angle of a point that determines the baseline length of a verified pair.
[COLMAP init_min_tri_angle]"""


class InitialPair(NamedTuple):
    """Two images with their relative pose, from which a component is initialized.

    The camera frame of the reference image is the world frame, and the depth prior of the reference
    image defines the unit of length.
    """

    reference: int
    """Index of the image whose camera frame is the world frame."""
    image: int
    """Index of the second image of the pair."""
    pose: ScoredPose
    """Pose ``cam_from_world`` of the second image of the pair, with its support."""


class InitialPairSelector:
    """Selector of initial image pairs, which estimates the relative pose of each pair once."""

    def __init__(self, options: MapperOptions) -> None:
        self._options = options
        self._results: dict[VerifiedPair, InitialPair | Reason] = {}

    def rank_pairs(
        self, pose_estimator: AbsolutePoseEstimator, candidates: Bool
    ) -> list[VerifiedPair]:
        """Rank the image pairs for initialization (COLMAP's ``FindInitialImagePair``).

        Image pairs are ranked by their number of matches. The ``NUM_COMPARED`` image pairs with
        most matches are ranked again by the support of their relative poses.

        Args:
            pose_estimator: Pose estimator on a scene without registered images.
            candidates: (n,) bool mask of the images that may be part of the initial pair.
        """
        pairs = [
            pair
            for pair in rank_initial_pairs(pose_estimator.scene)
            if candidates[pair.image_a] and candidates[pair.image_b]
        ]
        first_pairs = pairs[:NUM_COMPARED]
        results = {pair: self.estimate_pair(pose_estimator, pair) for pair in first_pairs}
        support = {
            pair: result.pose.support
            for pair, result in results.items()
            if isinstance(result, InitialPair)
        }
        first_pairs.sort(key=lambda pair: -support.get(pair, 0.0))
        return first_pairs + pairs[NUM_COMPARED:MAX_PAIRS]

    def estimate_pair(
        self, pose_estimator: AbsolutePoseEstimator, pair: VerifiedPair
    ) -> InitialPair | Reason:
        """Return the best supported relative pose of an image pair, or its rejection reason."""
        if pair not in self._results:
            scene, options = pose_estimator.scene, self._options
            if options.registration.lifting:
                candidates = estimate_initial_pairs(pose_estimator, pair, options.registration)
                best = max(candidates, key=lambda c: c.pose.support, default=None)
            elif pair.calibrated:
                best = scale_verified_pair(scene, pair)
            else:
                best = None
            self._results[pair] = best or ImageReason.NO_POSE.because()
        return self._results[pair]

    def reject_pair(self, pair: VerifiedPair, reason: Reason) -> None:
        """Record the reason why an image pair cannot initialize a component."""
        self._results[pair] = reason

    def state_dict(self, pairs: Sequence[VerifiedPair]) -> StateDict:
        """Return the estimated relative poses of image pairs for a checkpoint, by pair number."""
        state: StateDict = {}
        for number, pair in enumerate(pairs):
            result = self._results.get(pair)
            if isinstance(result, Reason):
                state[str(number)] = {"reason": result.to_json()}
            elif result is not None:
                state[str(number)] = {**result._asdict(), "pose": {**vars(result.pose)}}
        return state

    def load_state_dict(self, state: StateDict, pairs: Sequence[VerifiedPair]) -> None:
        """Restore the estimated relative poses of image pairs from a checkpoint."""
        for number, result in state.items():
            pair = pairs[int(number)]
            if "reason" in result:
                self._results[pair] = reason_from_json(ImageReason, result["reason"])
            else:
                self._results[pair] = InitialPair(
                    **{**result, "pose": ScoredPose(**result["pose"])}
                )


def register_first_image(scene: Scene, image: int) -> None:
    """Register an image at the world origin, so that its depth prior defines the unit."""
    scene.register(image, np.eye(3), np.zeros(3))
    scene.maps[image].set_scale(1.0)
    if scene.rigs.exist:
        scene.set_rig_scale(estimate_rig_scale(scene, image) or 1.0)
        set_frame_scales(scene, image)


def rank_initial_pairs(scene: Scene) -> list[VerifiedPair]:
    """Rank verified pairs of different frames by two-view geometry, then by number of matches."""
    frames = scene.rigs.frame_of
    pairs = [pair for pair in scene.problem.pairs if frames[pair.image_a] != frames[pair.image_b]]
    return sorted(pairs, key=lambda pair: (not pair.calibrated, -len(pair)))


def estimate_initial_pairs(
    pose_estimator: AbsolutePoseEstimator,
    pair: VerifiedPair,
    options: RegistrationOptions,
    *,
    refine: bool = True,
) -> list[InitialPair]:
    """Estimate relative poses of an image pair from depth-lifted points of either image.

    Args:
        pose_estimator: Pose estimator on a scene without registered images.
        pair: The verified pair.
        options: Options of the collection of 2D-3D correspondences.
        refine: Refine the estimated relative poses by bundle adjustment.
    """
    estimate = pose_estimator.estimate_poses if refine else pose_estimator.estimate_unrefined_poses
    return [
        InitialPair(reference, correspondences.image, pose)
        for reference, correspondences in _register_each_reference(
            pose_estimator.scene, pair, options
        )
        for pose in estimate(correspondences, attempt=0)
    ]


def refine_initial_pairs(
    pose_estimator: AbsolutePoseEstimator,
    pair: VerifiedPair,
    initial_pairs: Sequence[InitialPair],
    options: RegistrationOptions,
) -> list[InitialPair]:
    """Refine relative poses by bundle adjustment, except poses that lose support."""
    return [
        InitialPair(reference, correspondences.image, pose)
        for reference, correspondences in _register_each_reference(
            pose_estimator.scene, pair, options
        )
        for pose in pose_estimator.refine_poses(
            [initial.pose for initial in initial_pairs if initial.reference == reference],
            correspondences,
        )
    ]


def _register_each_reference(
    scene: Scene, pair: VerifiedPair, options: RegistrationOptions
) -> Iterator[tuple[int, PoseCorrespondences]]:
    """Yield the reference image and the 2D-3D matches, with either image as reference."""
    empty = scene.snapshot()
    for reference, image in ((pair.image_a, pair.image_b), (pair.image_b, pair.image_a)):
        register_first_image(scene, reference)
        yield reference, find_correspondences(scene, image, [reference], options)
        scene.restore(empty)


def scale_verified_pair(scene: Scene, pair: VerifiedPair) -> InitialPair | None:
    """Scale the pose of a verified pair so that triangulated depth agrees with the prior.

    The scale is the median ratio of prior and triangulated depth over the points whose
    triangulation angle is at least ``MIN_ANGLE_DEG``.

    Returns:
        The scaled pose, or None without a translation or a well triangulated point of known depth.
    """
    length = np.linalg.norm(pair.translation)
    if length < 1e-12:
        return None
    rotation, translation = pair.rotation, pair.translation / length
    offsets = scene.graph.offsets
    rays_a = scene.rays(pair.matches[:, 0] + offsets[pair.image_a])
    rays_b = scene.rays(pair.matches[:, 1] + offsets[pair.image_b])
    center_a, center_b = np.zeros(3), -rotation.T @ translation
    points = triangulate_midpoints(center_a, rays_a, center_b, rays_b @ rotation)
    depth_b = (points @ rotation.T + translation)[:, 2]
    with np.errstate(invalid="ignore"):
        angles_deg = triangulation_angle_deg(center_a, center_b, points)
        supporting = (points[:, 2] > 0) & (depth_b > 0)
        supporting &= angles_deg >= MIN_ANGLE_DEG
    depth_map = scene.maps[pair.image_a]
    rows = pair.matches[:, 0]
    known = supporting & depth_map.keypoint_valid[rows]
    if not known.any():
        return None
    depth_ratios = depth_map.prior_at_keypoints(rows)[known] / points[known, 2]
    num_points = int(supporting.sum())
    pose = ScoredPose(
        rotation,
        translation * float(np.median(depth_ratios)),
        "verified pair",
        support=float(num_points),
        num_inliers=num_points,
        inlier_ratio=1.0,  # geometric verification has removed outlier matches
    )
    return InitialPair(pair.image_a, pair.image_b, pose)
