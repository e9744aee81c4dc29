"""The first two images: which pairs to start from, and how one image lies beside the other.

With lifting, the pose is found as that of any next image, beside a scene of one view. Without, it
is that of the verified pair's essential matrix.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.geometry import triangulation_angle_deg
from mpsfm_core.mapping.options import InitializationOptions, MapperOptions, RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_midpoints


class InitialPair(NamedTuple):
    """Pose of ``image`` in a world whose origin is the camera of ``reference``, and whose unit is
    that of its prior."""

    reference: int
    image: int
    pose: ScoredPose


class InitialPairSelector:
    """First pairs and the poses they start with; each is found once."""

    def __init__(self, options: MapperOptions) -> None:
        self._options = options
        self._found: dict[VerifiedPair, InitialPair | Reason] = {}

    def rank_pairs(self, search: AbsolutePoseEstimator, left: Bool) -> list[VerifiedPair]:
        """Pairs to start from: of those with most matches, the best supported poses first.

        ``left``: (n,) bool, the images that may be in one.
        """
        options = self._options.initialization
        pairs = [p for p in rank_initial_pairs(search.scene) if left[p.image_a] and left[p.image_b]]
        first = pairs[: options.num_compared]
        starts = {pair: self.estimate_pair(search, pair) for pair in first}
        support = {k: v.pose.support for k, v in starts.items() if isinstance(v, InitialPair)}
        first.sort(key=lambda pair: -support.get(pair, 0.0))
        return first + pairs[options.num_compared : options.max_pairs]

    def estimate_pair(
        self, search: AbsolutePoseEstimator, pair: VerifiedPair
    ) -> InitialPair | Reason:
        """The best supported pose of one image beside the other, or why the pair is no start."""
        if pair not in self._found:
            scene, options = search.scene, self._options
            if options.registration.lifting:
                starts = estimate_pairs_from_depth(search, pair, options.registration)
                start = max(starts, key=lambda each: each.pose.support, default=None)
            elif pair.calibrated:
                start = scale_verified_pair(scene, pair, options.initialization)
            else:
                start = None
            self._found[pair] = start or ImageReason.NO_POSE.because()
        return self._found[pair]

    def reject_pair(self, pair: VerifiedPair, reason: Reason) -> None:
        """Remember why a pair is no start."""
        self._found[pair] = reason


def register_first_image(scene: Scene, image: int) -> None:
    """Let the world begin with an image."""
    scene.register(image, np.eye(3), np.zeros(3))
    scene.maps[image].set_scale(1.0)


def rank_initial_pairs(scene: Scene) -> list[VerifiedPair]:
    """Pairs to start from: calibrated configurations first, then by number of inliers."""
    return sorted(scene.problem.pairs, key=lambda pair: (not pair.calibrated, -len(pair)))


def estimate_pairs_from_depth(
    search: AbsolutePoseEstimator,
    pair: VerifiedPair,
    options: RegistrationOptions,
    *,
    rough: bool = False,
) -> list[InitialPair]:
    """Poses found as those of any next image, for each of both images; ``rough``: not refined."""
    find = search.estimate_unrefined_poses if rough else search.estimate_poses
    return [
        InitialPair(reference, image, pose)
        for reference, image, found in _each_way(search.scene, pair, options)
        for pose in find(image, found, attempt=0)
    ]


def refine_initial_pairs(
    search: AbsolutePoseEstimator,
    pair: VerifiedPair,
    rough: Sequence[InitialPair],
    options: RegistrationOptions,
) -> list[InitialPair]:
    """Rough starts of a pair with their poses bundle-adjusted, each if that finds more support."""
    return [
        InitialPair(reference, image, pose)
        for reference, image, found in _each_way(search.scene, pair, options)
        for pose in search.refine_poses(
            image, [start.pose for start in rough if start.reference == reference], found
        )
    ]


def _each_way(
    scene: Scene, pair: VerifiedPair, options: RegistrationOptions
) -> Iterator[tuple[int, int, PoseCorrespondences]]:
    """Either image of a pair alone in the scene, the other, and what that one is posed by."""
    empty = scene.snapshot()
    for reference, image in ((pair.image_a, pair.image_b), (pair.image_b, pair.image_a)):
        register_first_image(scene, reference)
        yield reference, image, find_correspondences(scene, image, [reference], options)
        scene.restore(empty)


def scale_verified_pair(
    scene: Scene, pair: VerifiedPair, options: InitializationOptions
) -> InitialPair | None:
    """The verified pose, its length chosen such that points agree with the prior."""
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
        angles = triangulation_angle_deg(center_a, center_b, points)
        safe = (points[:, 2] > 0) & (depth_b > 0)
        safe &= angles >= options.high_parallax_deg
    depth_map = scene.maps[pair.image_a]
    rows = pair.matches[:, 0]
    known = safe & depth_map.keypoint_valid[rows]
    if not known.any():
        return None
    ratio = depth_map.prior_at_keypoints(rows)[known] / points[known, 2]
    count = int(safe.sum())
    pose = ScoredPose(
        rotation,
        translation * float(np.median(ratio)),
        "verified pair",
        support=float(count),
        num_inliers=count,
        inlier_ratio=1.0,  # all verified matches agree with it
    )
    return InitialPair(pair.image_a, pair.image_b, pose)
