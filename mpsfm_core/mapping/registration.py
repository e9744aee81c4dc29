"""Pose of the next image from triangulated and depth-lifted points (paper section 3.2).

Pose hypotheses come from PnP and, since lifted points of an uncertain depth miss by many pixels
over a wide baseline, also from the essential matrices of the image's verified pairs with the
length that depth gives them. The one that most matches support wins. A match supports a pose if
its keypoint lies near the segment onto which the pose projects the other keypoint's ray between
the depths that the prior allows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, Int64, PinholeCamera
from mpsfm_core.geometry import compose, invert
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.triangulation import midpoints
from mpsfm_core.scene.scene import Scene

MIN_CORRESPONDENCES = 4
"""PnP needs three; the fourth chooses among the solutions."""
MIN_DEPTH_SHARE = 1e-3
"""Smallest share of its depth that an uncertain depth may shrink to."""


class Correspondences(NamedTuple):
    """Keypoints of an image and what they see.

    ``keypoints`` (m,): of the image. ``near``, ``far``: (m, 3) world points that bound where the
    point may lie along the ray of the matched keypoint (the same point twice when triangulated);
    ``points`` (m, 3): the best guess. ``references`` (m,): the image the match comes from.
    """

    keypoints: Int64
    points: Float64
    near: Float64
    far: Float64
    references: Int64


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """``cam_from_world``, its source, and the support of the reference image with most of it.

    ``support`` is the truncated quadratic score (MSAC) by which hypotheses are compared.
    """

    rotation: Float64
    translation: Float64
    source: str
    support: float
    num_inliers: int
    inlier_share: float


def estimate_absolute_pose(
    camera: PinholeCamera, xy: Float64, points: Float64, options: RegistrationOptions, seed: int
) -> tuple[Float64, Float64, Bool] | None:
    """Robust PnP of pixels (m, 2) and world points (m, 3).

    Returns rotation, translation and inliers (m,), or None when it fails.
    """
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
    return (
        np.asarray(pose.rotation.matrix(), dtype=np.float64),
        np.asarray(pose.translation, dtype=np.float64),
        np.asarray(result["inlier_mask"], dtype=np.bool_),
    )


def correspondences(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions
) -> Correspondences:
    """What the matches of an image to some registered images say of its pose.

    A matched keypoint gives its 3D point where that has enough parallax; else, with lifting, the
    part of its ray that depth allows.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = graph.edges_of(image)
    source, target = graph.source[edges], graph.target[edges]
    chosen = np.isin(graph.image_of[target], references)
    source, target = source[chosen], target[chosen]
    point = tracks.point_of[target]
    angle = np.append(scene.track_angles_deg(), 0.0)[point]
    stable = (point >= 0) & (angle >= options.min_point_angle_deg)
    lifted, valid = scene.lift(target)
    use = stable | (valid & options.lifting)
    source, target, stable, point = source[use], target[use], stable[use], point[use]
    points = lifted[use]
    points[stable] = tracks.xyz[point[stable]]
    log_std = np.concatenate([m.keypoint_log_std for m in scene.maps])[target]
    slack = np.where(stable, 0.0, options.depth_deviations * log_std)
    centers = scene.centers()[graph.image_of[target]]
    along = points - centers
    near = centers + along * np.maximum(np.exp(-slack), MIN_DEPTH_SHARE)[:, None]
    far = centers + along * np.exp(slack)[:, None]
    return Correspondences(source, points, near, far, graph.image_of[target])


def find_poses(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions, seed: int
) -> list[AbsolutePose]:
    """Possible poses of an image from its matches to the reference images, best support first."""
    found = correspondences(scene, image, references, options)
    poses = []
    for rotation, translation, source in _hypotheses(scene, image, found, options, seed):
        misfit = _misfits(scene, found, rotation, translation, options)
        support = np.bincount(found.references, 1 - misfit**2, minlength=scene.num_images)
        mine = misfit[found.references == support.argmax()] < 1
        poses.append(
            AbsolutePose(
                rotation,
                translation,
                source,
                float(support.max()),
                int(mine.sum()),
                float(mine.mean()),
            )
        )
    return sorted(poses, key=lambda pose: -pose.support)


def _hypotheses(
    scene: Scene,
    image: int,
    found: Correspondences,
    options: RegistrationOptions,
    seed: int,
) -> Iterator[tuple[Float64, Float64, str]]:
    """Poses by PnP on all correspondences, and by each reference image's essential matrix."""
    references = set(found.references.tolist())
    camera = scene.problem.images[image].camera
    xy = scene.keypoints[found.keypoints]
    pose = estimate_absolute_pose(camera, xy, found.points, options, seed)
    if pose:
        yield pose[0], pose[1], "PnP"
    for pair in scene.problem.pairs if options.lifting else ():
        if image not in (pair.image_a, pair.image_b) or not pair.calibrated:
            continue
        reference = pair.image_a if image == pair.image_b else pair.image_b
        if reference not in references:
            continue
        relative = (pair.rotation, pair.translation)
        if image == pair.image_a:
            relative = invert(*relative)
        world = (scene.rotations[reference], scene.translations[reference])
        length = _baseline(scene, found, reference, relative)
        if length is not None:
            rotation, translation = compose((relative[0], relative[1] * length), world)
            yield rotation, translation, "essential matrix"


def _baseline(
    scene: Scene, found: Correspondences, reference: int, relative: tuple[Float64, Float64]
) -> float | None:
    """Factor of a relative translation that brings triangulated points to the known depth."""
    mine = found.references == reference
    rotation, translation = relative
    known = found.points[mine] @ scene.rotations[reference].T + scene.translations[reference]
    rays_a = known / known[:, 2:]
    rays_b = scene.rays(found.keypoints[mine]) @ rotation
    center_b = -rotation.T @ translation
    z = midpoints(np.zeros(3), rays_a, center_b, rays_b)[:, 2]
    with np.errstate(invalid="ignore"):
        good = (z > 0) & (known[:, 2] > 0)
    return float(np.median(known[good, 2] / z[good])) if good.any() else None


def _misfits(
    scene: Scene,
    found: Correspondences,
    rotation: Float64,
    translation: Float64,
    options: RegistrationOptions,
) -> Float64:
    """(m,) distance of keypoints to the projection of their allowed segment, in limits, <= 1."""
    fx, fy, cx, cy = scene.intrinsics[scene.graph.image_of[found.keypoints]].T
    xy = scene.keypoints[found.keypoints]
    ends = []
    for points in (found.near, found.far):
        camera = points @ rotation.T + translation
        z = np.where(camera[:, 2] > 1e-9, camera[:, 2], np.nan)
        ends.append(np.stack([fx * camera[:, 0] / z + cx, fy * camera[:, 1] / z + cy], axis=1))
    along = ends[1] - ends[0]
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((xy - ends[0]) * along).sum(axis=1) / length, 0, 1)
    distance = np.linalg.norm(ends[0] + share[:, None] * along - xy, axis=1)
    limit = options.max_support_error_px * scene.keypoint_std_px
    misfits: Float64 = distance / limit[scene.graph.image_of[found.keypoints]]
    return np.where(misfits < 1, misfits, 1.0)
