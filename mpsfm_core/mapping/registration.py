"""Pose of the next image from triangulated and depth-lifted points (paper section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, Int64, PinholeCamera
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.scene.scene import Scene

MIN_CORRESPONDENCES = 4
"""PnP needs three; the fourth chooses among the solutions."""


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """``cam_from_world`` and which correspondences support it, (m,) bool."""

    rotation: Float64
    translation: Float64
    inliers: Bool

    @property
    def num_inliers(self) -> int:
        """Number of supporting correspondences."""
        return int(self.inliers.sum())

    @property
    def inlier_share(self) -> float:
        """Share of the correspondences that support the pose."""
        return float(self.inliers.mean())


def estimate_absolute_pose(
    camera: PinholeCamera, xy: Float64, points: Float64, options: RegistrationOptions, seed: int
) -> AbsolutePose | None:
    """Robust PnP of pixels (m, 2) and world points (m, 3); None when it fails."""
    if len(xy) < MIN_CORRESPONDENCES:
        return None
    ransac = pycolmap.RANSACOptions(
        max_error=options.max_error_px,
        min_inlier_ratio=options.min_inlier_ratio,
        confidence=0.99999,  # COLMAP, reference
        min_num_trials=100,
        max_num_trials=10_000,
        random_seed=seed,
    )
    result = pycolmap.estimate_and_refine_absolute_pose(
        xy,
        points,
        pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height, params=camera.params
        ),
        pycolmap.AbsolutePoseEstimationOptions(ransac=ransac),
    )
    if result is None:
        return None
    pose = result["cam_from_world"]
    return AbsolutePose(
        np.asarray(pose.rotation.matrix(), dtype=np.float64),
        np.asarray(pose.translation, dtype=np.float64),
        np.asarray(result["inlier_mask"], dtype=np.bool_),
    )


def correspondences(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions
) -> tuple[Int64, Float64]:
    """Keypoints of an image (m,) and world points (m, 3) from its matches to some images.

    A matched keypoint gives its 3D point where that has enough parallax; else, with lifting, its
    own lift from depth. A triangulated point counts once for each keypoint of the new image.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = graph.edges_of(image)
    source, target = graph.source[edges], graph.target[edges]
    chosen = np.isin(graph.image_of[target], references)
    source, target = source[chosen], target[chosen]
    point = tracks.point_of[target]
    angle = np.append(scene.track_angles_deg(), 0.0)[point]
    stable = (point >= 0) & (angle >= options.min_point_angle_deg)
    place = source[stable] * max(len(tracks.xyz), 1) + point[stable]
    _, first = np.unique(place, return_index=True)
    keypoints, xyz = source[stable][first], tracks.xyz[point[stable][first]]
    if options.lifting:
        lifted, valid = scene.lift(target[~stable])
        keypoints = np.concatenate([keypoints, source[~stable][valid]])
        xyz = np.concatenate([xyz, lifted[valid]])
    return keypoints, xyz


def find_pose(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions, seed: int
) -> AbsolutePose | None:
    """Pose of an image from its matches to the reference images; None when PnP fails."""
    keypoints, points = correspondences(scene, image, references, options)
    camera = scene.problem.images[image].camera
    return estimate_absolute_pose(camera, scene.keypoints[keypoints], points, options, seed)
