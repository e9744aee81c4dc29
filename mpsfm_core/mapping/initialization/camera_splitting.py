"""Detection of images whose points support another focal length than that of their camera.

Photos without EXIF may differ in zoom or crop although their sizes are equal. The pose of a zoomed
or cropped image is estimated with the shared focal length and with a focal length of its own. The
image gets its own camera if its own focal length clearly reduces the reprojection errors. Where
focal length and distance are ambiguous, for example for a frontal plane, the reprojection errors
are equal. An image with a camera of its own may be misregistered with a wrong focal length, and is
then registered again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import Float64, Int64, MappingImage, MappingProblem, PinholeCamera, Pose
from mpsfm_core.data.camera_models import to_distortion
from mpsfm_core.geometry.distortion import change_distortion
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_hypotheses import (
    MAX_FOCAL_CORRESPONDENCES,
    estimate_absolute_pose,
    estimate_pose_with_focal,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.support.threads import parallel_map

MIN_FOCAL_RATIO = 1.05
"""Ratio between the focal length of an image and that of its shared camera, from which the image
gets its own camera. [ours]"""
MAX_COST_RATIO = 0.6
"""Ratio of the costs of the poses with own and shared focal length below which an image gets its
own camera. A cost is the mean of ``min(1, (error / MAX_ERROR_STDS)^2)``. The ratio of zoomed images
is below 0.45, that of others above 0.9. [tuned: benchmarks.verdicts]"""
MIN_COST = 0.03
"""Cost of the pose with shared focal length below which no other focal length is tried. [ours]"""
MAX_ERROR_STDS = 4.0
"""Largest reprojection error of a match that supports a pose, in standard deviations of the
keypoint position. A wrong focal length causes reprojection errors of only a few pixels. [COLMAP
filter_max_reproj_error]"""
MIN_OTHER_IMAGES = 2
"""Minimum number of other images that observe a point, so that the tested image does not determine
the position of the point. [ours]"""


def find_deviating_focals(
    problem: MappingProblem,
    model: Reconstruction,
    options: RegistrationOptions,
    seed: int,
    *,
    is_shared: bool = True,
) -> dict[int, float]:
    """Find images whose points support another focal length than that of their camera.

    Args:
        problem: Mapping problem that was reconstructed.
        model: Largest component of the reconstruction.
        options: Options of absolute pose estimation.
        seed: Seed of RANSAC.
        is_shared: True to examine images that share a camera, False to examine images with their
            own.

    Returns:
        Focal lengths ``fx`` in pixels of the images with a deviating focal length, by image index.
    """
    guessed = [image.shared_camera for image in problem.images if not image.focal_known]
    num_images = Counter(guessed)
    cameras = {problem.images[i.index].shared_camera: i.camera for i in model.images}
    distortions = {
        problem.images[i.index].shared_camera: to_distortion(i.distortion) for i in model.images
    }
    examined = {
        index
        for index, image in enumerate(problem.images)
        if not image.focal_known
        and not image.camera_model.is_fisheye
        and (num_images[image.shared_camera] > 1) == is_shared
    }
    correspondences = _collect_correspondences(problem, model, examined)

    def measure(index: int) -> float | None:
        keypoints, points = correspondences[index]
        image = problem.images[index]
        camera = cameras.get(image.shared_camera, image.camera)
        if len(keypoints) < options.min_inliers:
            return None
        step = max(1, len(keypoints) // MAX_FOCAL_CORRESPONDENCES)
        xy, xyz = image.keypoints[keypoints[::step]], model.points[points[::step]]
        distortion = distortions.get(image.shared_camera, image.distortion)
        xy = change_distortion(xy, (image.camera, image.distortion), (camera, distortion))
        max_error_px = MAX_ERROR_STDS * image.keypoint_std_px
        shared = estimate_absolute_pose(camera, xy, xyz, options, seed)
        cost = _measure_cost(camera, shared[:2], xy, xyz, max_error_px) if shared else 1.0
        if cost < MIN_COST:
            return None
        # RANSAC may assume this share of inliers: a pose with fewer inliers is rejected below.
        min_inlier_ratio = max(options.min_inlier_ratio, 1.0 - MAX_COST_RATIO * cost)
        strict = options.model_copy(update={"min_inlier_ratio": min_inlier_ratio})
        own = estimate_pose_with_focal(camera, xy, xyz, strict, seed)
        if own is None or abs(np.log(own.focal_px / camera.fx)) < np.log(MIN_FOCAL_RATIO):
            return None
        own_cost = _measure_cost(own.camera, own.pose, xy, xyz, max_error_px)
        return own.focal_px if own_cost < MAX_COST_RATIO * cost else None

    focals = zip(correspondences, parallel_map(measure, list(correspondences)), strict=True)
    return {index: focal_px for index, focal_px in focals if focal_px is not None}


def split_cameras(
    images: Sequence[MappingImage], own_focals: Mapping[int, float]
) -> tuple[MappingImage, ...]:
    """Return all images, and assign an own camera to images with a deviating focal length.

    Args:
        images: All images of the mapping problem.
        own_focals: Focal lengths ``fx`` in pixels of the images that get their own camera, by image
            index.
    """
    first_id = 1 + max((image.camera_id for image in images), default=0)
    split = list(images)
    for number, (index, focal_px) in enumerate(own_focals.items(), first_id):
        image = images[index]
        aspect = image.camera.fy / image.camera.fx
        camera = replace(image.camera, fx=focal_px, fy=focal_px * aspect)
        split[index] = replace(image.with_camera(camera), camera_id=number)
    return tuple(split)


def _collect_correspondences(
    problem: MappingProblem, model: Reconstruction, examined: Collection[int]
) -> dict[int, tuple[Int64, Int64]]:
    """Return the 2D-3D matches of images, as rows of keypoints (m,) and of 3D points (m,)."""
    if not examined:
        return {}
    point_ids = {image.index: image.point_ids for image in model.images}
    observed = [np.unique(ids[ids >= 0]) for ids in point_ids.values()]
    no_points = np.zeros(0, dtype=np.int64)
    num_observers = np.bincount(np.concatenate([no_points, *observed]), minlength=len(model.points))
    matches: dict[int, list[Int64]] = {}
    for pair in problem.pairs:
        for image, other, column in (
            (pair.image_a, pair.image_b, 0),
            (pair.image_b, pair.image_a, 1),
        ):
            if other not in point_ids or image not in examined:
                continue
            points = point_ids[other][pair.matches[:, 1 - column]]
            # np.unique sorts integers faster than rows, so each keypoint and its point are
            # combined to one integer.
            codes = pair.matches[:, column] * len(model.points) + points
            matches.setdefault(image, []).append(codes[points >= 0])
    correspondences = {}
    for image, parts in matches.items():
        keypoints, points = np.divmod(np.unique(np.concatenate(parts)), len(model.points))
        is_own = np.isin(points, point_ids.get(image, no_points))
        is_used = num_observers[points] - is_own >= MIN_OTHER_IMAGES
        correspondences[image] = keypoints[is_used], points[is_used]
    return correspondences


def _measure_cost(
    camera: PinholeCamera, pose: Pose, xy: Float64, points: Float64, max_error_px: float
) -> float:
    """Return the mean MSAC cost ``min(1, (error / max_error_px)^2)`` of a pose, in [0, 1]."""
    in_camera = points @ pose[0].T + pose[1]
    in_front = in_camera[:, 2] > 0
    z = np.where(in_front, in_camera[:, 2], 1.0)
    projected = in_camera[:, :2] / z[:, None] * camera.params[:2] + camera.params[2:]
    squared = ((projected - xy) ** 2).sum(axis=1) / max_error_px**2
    return float(np.where(in_front, np.minimum(1.0, squared), 1.0).mean())
