"""The first two images: which pairs to start from, and how one image lies beside the other.

With lifting, the pose is found as that of any next image, beside a scene of one view. Without, it
is that of the verified pair's essential matrix.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import VerifiedPair
from mpsfm_core.geometry import triangulation_angle_deg
from mpsfm_core.mapping.options import InitializationOptions
from mpsfm_core.mapping.registration import AbsolutePose
from mpsfm_core.mapping.triangulation import midpoints
from mpsfm_core.scene.scene import Scene


class Start(NamedTuple):
    """Pose of ``image`` in a world whose origin is the camera of ``reference``, and whose unit is
    that of its prior."""

    reference: int
    image: int
    pose: AbsolutePose


def rank_initial_pairs(scene: Scene) -> list[VerifiedPair]:
    """Pairs to start from: calibrated configurations first, then by number of inliers."""
    return sorted(scene.problem.pairs, key=lambda pair: (not pair.calibrated, -len(pair)))


def start_from_rays(
    scene: Scene, pair: VerifiedPair, options: InitializationOptions
) -> Start | None:
    """Pose of the essential matrix, its length chosen such that points agree with the prior."""
    length = np.linalg.norm(pair.translation)
    if not pair.calibrated or length < 1e-12:
        return None
    rotation, translation = pair.rotation, pair.translation / length
    offsets = scene.graph.offsets
    rays_a = scene.rays(pair.matches[:, 0] + offsets[pair.image_a])
    rays_b = scene.rays(pair.matches[:, 1] + offsets[pair.image_b])
    center_a, center_b = np.zeros(3), -rotation.T @ translation
    points = midpoints(center_a, rays_a, center_b, rays_b @ rotation)
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
    pose = AbsolutePose(
        rotation,
        translation * float(np.median(ratio)),
        "essential matrix",
        support=float(count),
        num_inliers=count,
        inlier_share=1.0,  # all verified matches agree with it
    )
    return Start(pair.image_a, pair.image_b, pose)
