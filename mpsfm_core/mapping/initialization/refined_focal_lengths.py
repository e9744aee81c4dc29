"""Transfer of refined focal lengths from one mapper run to the problem of the next run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, Int64, MappingImage, MappingProblem, VerifiedPair
from mpsfm_core.data.camera_models import IntrinsicParameter, to_distortion
from mpsfm_core.geometry.distortion import change_distortion
from mpsfm_core.geometry.two_view import estimate_two_view_geometry
from mpsfm_core.mapping.initialization.camera_splitting import (
    find_deviating_focals,
    split_cameras,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.estimated_intrinsics import MIN_FOCAL_IMAGES
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.support.threads import parallel_map

MIN_FOCAL_CHANGE = 1.1
"""Ratio of refined and initial focal length from which the initial focal length has distorted the
relative poses of pairs, so that the mapper runs again. [ours]"""
MAX_ERROR_PX = 4.0
"""Largest error of an inlier of the two-view geometry. [COLMAP two-view max_error]"""
MAX_MATCHES = 100
"""Approximate maximum number of matches of each pair that estimate a relative pose or a focal
length; the run time is proportional. [tuned: benchmarks.walks]"""
MIN_INLIER_RATIO = 0.25
"""Assumed inlier ratio from which RANSAC computes its number of trials. [COLMAP two-view
min_inlier_ratio]
"""
MIN_INLIERS = 15
"""Minimum number of inliers with which a new relative pose of a pair replaces the previous one.
[COLMAP min_num_inliers]"""


def apply_refined_focal_lengths(
    problem: MappingProblem, model: Reconstruction, options: MapperOptions
) -> MappingProblem | None:
    """Return the problem with refined focal lengths of a model and new relative poses.

    If no focal length changed much, images that deviate from the focal length of their shared
    camera get their own cameras. The priors on focal lengths keep their original means. Each pair
    of an image whose focal length changes gets a new relative pose from its matches.

    Args:
        problem: The mapping problem that was reconstructed.
        model: Its largest component.
        options: Options of the mapper.

    Returns:
        The updated mapping problem, or None if no focal length changed by ``MIN_FOCAL_CHANGE`` or
        more and no camera is split.
    """
    images = _apply_shared_focals(problem, model)
    if images == problem.images:
        own_focals = find_deviating_focals(problem, model, options.registration, options.seed)
        images = split_cameras(problem.images, own_focals)
    if images == problem.images:
        return None
    changed = [new is not old for new, old in zip(images, problem.images, strict=True)]
    refined = replace(problem, images=images)
    return estimate_relative_poses(refined, np.array(changed), options.seed)


def _apply_shared_focals(
    problem: MappingProblem, model: Reconstruction
) -> tuple[MappingImage, ...]:
    """Return the images with focal lengths that refinement changed by ``MIN_FOCAL_CHANGE``.

    An image with a changed focal length also takes the refined distortion of its camera, if at
    least ``MIN_FOCAL_IMAGES`` images of the model share the camera.
    """
    num_images = Counter(problem.images[image.index].shared_camera for image in model.images)
    refined = {
        problem.images[image.index].shared_camera: image
        for image in model.images
        if image.calibration[IntrinsicParameter.FOCAL_LENGTH].is_refined
        and abs(np.log(image.camera.fx / problem.images[image.index].camera.fx))
        >= np.log(MIN_FOCAL_CHANGE)
    }
    images = []
    for image in problem.images:
        source = refined.get(image.shared_camera)
        if image.focal_known or source is None:
            images.append(image)
            continue
        changed = image.with_camera(source.camera)
        is_shared = num_images[image.shared_camera] >= MIN_FOCAL_IMAGES
        if is_shared and not image.camera_model.is_fisheye:
            changed = replace(changed, initial_distortion=to_distortion(source.distortion))
        images.append(changed)
    return tuple(images)


def estimate_relative_poses(problem: MappingProblem, changed: Bool, seed: int) -> MappingProblem:
    """Return the problem with new relative poses of the pairs of changed images.

    Args:
        problem: Mapping problem with changed intrinsics or keypoints of some images.
        changed: (n,) bool mask of the images with changed intrinsics or keypoints.
        seed: Seed of RANSAC.
    """
    keypoints = [_undistort_keypoints(image) for image in problem.images]

    def estimate(pair: VerifiedPair) -> VerifiedPair:
        if changed[pair.image_a] or changed[pair.image_b]:
            return _estimate_relative_pose(problem, keypoints, pair, seed)
        return pair

    return replace(problem, pairs=tuple(parallel_map(estimate, problem.pairs)))


def select_matches(pair: VerifiedPair) -> Int64:
    """Return about ``MAX_MATCHES`` evenly spaced matches (m, 2) of a pair, or all if fewer."""
    return pair.matches[:: max(1, len(pair) // MAX_MATCHES)]


def _estimate_relative_pose(
    problem: MappingProblem, keypoints: Sequence[Float64], pair: VerifiedPair, seed: int
) -> VerifiedPair:
    """Return a pair with a new relative pose if COLMAP's two-view geometry has one.

    Args:
        problem: Mapping problem that contains the pair.
        keypoints: Keypoints (k, 2) of each image without its initial distortion, in pixels.
        pair: The pair.
        seed: Seed of RANSAC.
    """
    image_a, image_b = problem.images[pair.image_a], problem.images[pair.image_b]
    matches = select_matches(pair)
    geometry = estimate_two_view_geometry(
        image_a.camera,
        image_b.camera,
        keypoints[pair.image_a][matches[:, 0]],
        keypoints[pair.image_b][matches[:, 1]],
        max_error_px=MAX_ERROR_PX * max(image_a.keypoint_std_px, image_b.keypoint_std_px),
        min_inlier_ratio=MIN_INLIER_RATIO,
        min_inliers=MIN_INLIERS,
        seed=seed,
    )
    pose = geometry.cam2_from_cam1
    if pose is None:
        return pair
    return replace(
        pair,
        rotation=np.array(pose.rotation.matrix(), order="C"),
        translation=np.array(pose.translation),
        calibrated=geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
    )


def _undistort_keypoints(image: MappingImage) -> Float64:
    """Return the keypoints (k, 2) of an image without its initial distortion, in pixels."""
    if image.initial_distortion is None:
        return image.keypoints
    old = image.camera, image.distortion
    return change_distortion(image.keypoints, old, (image.camera, image.initial_distortion))
