"""Support of a pose by 2D-3D correspondences, and local pose refinement.

The ray of a matched keypoint, between the nearest and farthest depth that the depth prior allows,
projects to a segment in the new image. A correspondence is an inlier if its keypoint is close to
the projected ray segment and the resulting depth agrees with the new image's depth prior. The
support of a pose is the weighted MSAC score ``sum_i w_i (1 - r_i^2)``, where ``r_i`` is the larger
of the reprojection and depth residuals relative to their thresholds, truncated at 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Bool, Float64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.registration.pose_hypotheses import (
    MAX_SUPPORT_ERROR_PX,
    PoseHypothesis,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.optimize.resection import (
    FrameImage,
    RaySegments,
    measure_segments,
    refine_pose,
)

CONFIDENT_INLIER_RATIO = 0.85
"""Inlier ratio of a pose above which no further pose hypotheses are generated. [ours]"""
REFINEMENT_SCALES = np.maximum(5.0 * 0.8 ** np.arange(12), 1.0)
"""Factors of the inlier threshold in successive Gauss-Newton steps. The factors start large because
a RANSAC pose from lifted points can have reprojection errors of many pixels. [ours]"""


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """Pose of an image with its support by 2D-3D correspondences."""

    rotation: Float64
    """(3, 3) ``cam_from_world``."""
    translation: Float64
    """(3,) ``cam_from_world``."""
    source: str
    """Name of the method that estimated the pose."""
    support: float
    """Weighted MSAC score by which pose hypotheses are compared."""
    num_inliers: int
    """Number of inliers, where inliers of unknown depth count by their weight."""
    inlier_ratio: float
    """Weighted share of the correspondences that are inliers, in [0, 1]."""
    focal_px: float | None = None
    """Focal length ``fx`` that was estimated with the pose, or None if the pose was estimated with
    the present focal length."""

    @property
    def hypothesis(self) -> PoseHypothesis:
        """The estimated pose without its support."""
        return PoseHypothesis(self.rotation, self.translation, self.source, self.focal_px)


def score_pose(
    scene: Scene,
    correspondences: PoseCorrespondences,
    hypothesis: PoseHypothesis,
    options: RegistrationOptions,
) -> ScoredPose:
    """Compute the support of a pose by its correspondences.

    Args:
        scene: The scene with the registered images.
        correspondences: 2D-3D correspondences of the image and of the images of its frame.
        hypothesis: The pose of the image.
        options: Registration options, of which ``max_depth_deviation`` limits the inliers.
    """
    residuals = _compute_residuals(scene, correspondences, hypothesis, options)
    inlier = residuals < 1

    frames = correspondences.frames(scene)

    def sum_per_frame(values: Float64) -> Float64:
        return np.bincount(frames, values, minlength=scene.num_images).astype(np.float64)

    support = sum_per_frame(correspondences.weights * (1 - residuals**2))
    best = int(np.argmax(support))
    total = sum_per_frame(correspondences.weights)[best]
    inlier_weight = sum_per_frame(correspondences.weights * inlier)[best]
    return ScoredPose(
        hypothesis.rotation,
        hypothesis.translation,
        hypothesis.source,
        float(support[best]),
        int(sum_per_frame(correspondences.depth_weights * inlier)[best]),
        float(inlier_weight / total) if total else 0.0,
        hypothesis.focal_px,
    )


def maximize_support(
    scene: Scene,
    correspondences: PoseCorrespondences,
    pose: ScoredPose,
    options: RegistrationOptions,
) -> ScoredPose:
    """Refine a pose by minimizing the distances of keypoints to their projected ray segments.

    The robust loss is Tukey's biweight (see :func:`mpsfm_core.optimize.resection.refine_pose`). The
    pose is returned unchanged if there are no correspondences.
    """
    if not len(correspondences.keypoints):
        return pose
    rotation, translation = refine_pose(
        (pose.rotation, pose.translation),
        [
            FrameImage(
                scene.rigs.relative_pose(correspondences.image, image),
                _get_intrinsics(scene, image, correspondences, pose.focal_px),
                _make_segments(scene, correspondences.select(rows), options),
            )
            for image, rows in correspondences.split_by_image(scene)
        ],
        scales=REFINEMENT_SCALES,
    )
    refined = PoseHypothesis(rotation, translation, pose.source, pose.focal_px)
    return score_pose(scene, correspondences, refined, options)


def _get_intrinsics(
    scene: Scene, image: int, correspondences: PoseCorrespondences, focal_px: float | None
) -> Float64:
    """Return fx, fy, cx, cy of an image of a frame whose first camera may have another ``fx``."""
    shares_camera = scene.camera_of[image] == scene.camera_of[correspondences.image]
    return scene.intrinsics_with_focal(image, focal_px if shares_camera else None)


def _make_segments(
    scene: Scene, correspondences: PoseCorrespondences, options: RegistrationOptions
) -> RaySegments:
    std_px = scene.keypoint_std_px[scene.graph.image_of[correspondences.keypoints]]
    return RaySegments(
        near=correspondences.near_points,
        far=correspondences.far_points,
        xy=scene.keypoints[correspondences.keypoints],
        limit=MAX_SUPPORT_ERROR_PX * std_px,
        weight=correspondences.weights,
    )


def _compute_residuals(
    scene: Scene,
    correspondences: PoseCorrespondences,
    pose: PoseHypothesis,
    options: RegistrationOptions,
) -> Float64:
    """Return the residuals (m,) of a pose relative to their thresholds, truncated at 1."""
    residuals = [np.empty(0)]
    for image, rows in correspondences.split_by_image(scene):
        of_image = correspondences.select(rows)
        image_pose = scene.rigs.derive_pose(
            correspondences.image, (pose.rotation, pose.translation), image
        )
        segments = _make_segments(scene, of_image, options)
        intrinsics = _get_intrinsics(scene, image, of_image, pose.focal_px)
        distances_px, depths = measure_segments(image_pose, intrinsics, segments)
        distances = distances_px / segments.limit
        depth_residuals = _compute_depth_residuals(
            scene, image, of_image, depths, distances < 1, options
        )
        residuals.append(np.fmax(distances, depth_residuals))
    combined = np.concatenate(residuals)
    return np.where(combined < 1, combined, 1.0)


def _compute_depth_residuals(
    scene: Scene,
    image: int,
    correspondences: PoseCorrespondences,
    depths: Float64,
    is_near: Bool,
    options: RegistrationOptions,
) -> Float64:
    """Return residuals (m,) of log depth to the new image's prior, relative to the threshold.

    The scale of the depth prior is the median depth ratio over the keypoints near their projected
    segments. The depth residual is NaN if a depth is unknown.
    """
    residuals = np.full(len(depths), np.nan)
    rows = correspondences.keypoints - scene.graph.offsets[image]
    known = correspondences.depth_known & scene.maps[image].keypoint_valid[rows] & (depths > 0)
    if (known & is_near).any():
        log_ratio = np.log(depths[known] / scene.maps[image].prior_at_keypoints(rows[known]))
        image_std = scene.keypoint_log_std[correspondences.keypoints[known]]
        reference_std = scene.keypoint_log_std[correspondences.matched_keypoints[known]]
        limit = options.max_depth_deviation * np.hypot(image_std, reference_std)
        log_scale = np.median(log_ratio[is_near[known]])
        residuals[known] = np.abs(log_ratio - log_scale) / limit
    return residuals
