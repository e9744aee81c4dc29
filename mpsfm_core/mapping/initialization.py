"""The first two images: relative pose from rays or, at low parallax, from lifted depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64, Int64, VerifiedPair
from mpsfm_core.geometry import triangulation_angle_deg
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration import estimate_absolute_pose
from mpsfm_core.mapping.triangulation import midpoints
from mpsfm_core.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class InitialPose:
    """``cam_b_from_cam_a`` in units of the first image's prior, and where it comes from."""

    rotation: Float64
    translation: Float64
    source: str
    num_inliers: int


def rank_initial_pairs(scene: Scene) -> list[VerifiedPair]:
    """Pairs to start from: calibrated configurations first, then by number of inliers."""
    return sorted(scene.problem.pairs, key=lambda pair: (not pair.calibrated, -len(pair)))


def initial_pose(scene: Scene, pair: VerifiedPair, options: MapperOptions) -> InitialPose | str:
    """Pose of a pair, or in words why it has none.

    The essential matrix wins if it triangulates more points at a safe angle than PnP on the
    depth-lifted keypoints of the first image has inliers (paper section 3.1).
    """
    lifted = _pose_from_lift(scene, pair, options) if options.registration.lifting else None
    triangulated = _pose_from_rays(scene, pair, options)
    best = triangulated
    if lifted and (best is None or best.num_inliers <= lifted.num_inliers):
        best = lifted
    if best is None:
        return "neither the essential matrix nor lifted depth gives a pose"
    if best.num_inliers < options.initialization.min_inliers:
        return f"only {best.num_inliers} inliers support the pose from {best.source}"
    return best


def _pose_from_lift(scene: Scene, pair: VerifiedPair, options: MapperOptions) -> InitialPose | None:
    image = scene.problem.images[pair.image_b]
    keypoints_a, keypoints_b = _global_keypoints(scene, pair)
    depth_map = scene.maps[pair.image_a]
    rows = pair.matches[:, 0]
    valid = depth_map.keypoint_valid[rows]
    points = scene.rays(keypoints_a) * depth_map.prior_at_keypoints(rows)[:, None]
    xy = scene.keypoints[keypoints_b]
    pose = estimate_absolute_pose(
        image.camera, xy[valid], points[valid], options.registration, options.seed
    )
    if pose is None:
        return None
    return InitialPose(pose[0], pose[1], "lifted depth", int(pose[2].sum()))


def _pose_from_rays(scene: Scene, pair: VerifiedPair, options: MapperOptions) -> InitialPose | None:
    """Pose of the essential matrix, its length chosen such that points agree with the prior."""
    length = np.linalg.norm(pair.translation)
    if not pair.calibrated or length < 1e-12:
        return None
    rotation, translation = pair.rotation, pair.translation / length
    keypoints_a, keypoints_b = _global_keypoints(scene, pair)
    center_a, center_b = np.zeros(3), -rotation.T @ translation
    points = midpoints(
        center_a, scene.rays(keypoints_a), center_b, scene.rays(keypoints_b) @ rotation
    )
    depth_b = (points @ rotation.T + translation)[:, 2]
    with np.errstate(invalid="ignore"):
        angles = triangulation_angle_deg(center_a, center_b, points)
        safe = (points[:, 2] > 0) & (depth_b > 0)
        safe &= angles >= options.initialization.high_parallax_deg
    depth_map = scene.maps[pair.image_a]
    rows = pair.matches[:, 0]
    known = safe & depth_map.keypoint_valid[rows]
    if not known.any():
        return None
    ratio = depth_map.prior_at_keypoints(rows)[known] / points[known, 2]
    return InitialPose(
        rotation, translation * float(np.median(ratio)), "the essential matrix", int(safe.sum())
    )


def _global_keypoints(scene: Scene, pair: VerifiedPair) -> tuple[Int64, Int64]:
    offsets = scene.graph.offsets
    return pair.matches[:, 0] + offsets[pair.image_a], pair.matches[:, 1] + offsets[pair.image_b]
