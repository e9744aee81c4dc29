"""Pose of the next image from triangulated and depth-lifted points (paper section 3.2).

Lifted points of an uncertain depth miss by many pixels over a wide baseline, so one PnP is not
enough. Hypotheses come from PnP on the points of the scene, from PnP the other way round (the new
image's own lifts seen in a registered image), and from the essential matrices of verified pairs
with the length that depth gives them. The one that most matches support wins. A match supports a
pose if its keypoint lies near the segment onto which the other keypoint's ray projects between
the depths that the prior allows, and if the depth that follows fits the new image's own prior.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, Int64, PinholeCamera
from mpsfm_core.geometry import compose, invert, rotation_angle_deg
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.triangulation import midpoints
from mpsfm_core.scene.scene import Scene

MIN_CORRESPONDENCES = 4
"""PnP needs three; the fourth chooses among the solutions."""
PNP_ERROR_FACTORS = (1.0, 4.0)
"""PnP is tried with the allowed error and with this multiple of it, for lifts that miss widely over
a wide baseline (ours)."""
MIN_TURN_DEG = 3.0
"""Hypotheses that differ less are refined to the same pose (ours)."""
MIN_DEPTH_SHARE = 1e-3
"""Smallest share of its depth that an uncertain depth may shrink to."""


Hypothesis = tuple[Float64, Float64, str]
"""Rotation, translation, and where they come from."""


class Correspondences(NamedTuple):
    """Keypoints of an image and what they see.

    ``keypoints`` (m,): of the image. ``matched`` (m,): their matches in registered images.
    ``near``, ``far``: (m, 3) world points that bound where the
    point may lie along the ray of the matched keypoint (the same point twice when triangulated);
    ``points`` (m, 3): the best guess. ``references`` (m,): the image the match comes from.
    ``scores`` (m,): of the matches, in (0, 1].
    """

    keypoints: Int64
    matched: Int64
    points: Float64
    near: Float64
    far: Float64
    references: Int64
    scores: Float64


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """``cam_from_world``, its source, and the support of the reference image with most of it.

    ``support`` is the truncated quadratic score (MSAC) by which hypotheses are compared, weighted
    by the scores of the matches, as is ``inlier_share``.
    """

    rotation: Float64
    translation: Float64
    source: str
    support: float
    num_inliers: int
    inlier_share: float


def colmap_camera(camera: PinholeCamera) -> pycolmap.Camera:
    """The camera as COLMAP's estimators want it."""
    return pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=camera.params
    )


def estimate_absolute_pose(
    camera: PinholeCamera,
    xy: Float64,
    points: Float64,
    options: RegistrationOptions,
    seed: int,
    error_factor: float = 1.0,
    *,
    refine: bool = True,
) -> tuple[Float64, Float64, Bool] | None:
    """Robust PnP of pixels (m, 2) and world points (m, 3).

    Returns rotation, translation and inliers (m,), or None when it fails. ``refine``: also
    minimise the reprojection error of the inliers; RANSAC alone takes a fifth of the time.
    """
    if len(xy) < MIN_CORRESPONDENCES:
        return None
    ransac = pycolmap.RANSACOptions(
        max_error=options.max_error_px * error_factor,
        min_inlier_ratio=options.min_inlier_ratio,
        confidence=0.99999,  # COLMAP, reference
        min_num_trials=100,
        max_num_trials=10_000,
        random_seed=seed,
    )
    estimate = (
        pycolmap.estimate_and_refine_absolute_pose if refine else pycolmap.estimate_absolute_pose
    )
    result = estimate(
        xy,
        points,
        colmap_camera(camera),
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
    source, target, scores = graph.source[edges], graph.target[edges], graph.score[edges]
    chosen = np.isin(graph.image_of[target], references)
    source, target, scores = source[chosen], target[chosen], scores[chosen]
    point = tracks.point_of[target]
    angle = np.append(scene.track_angles_deg(), 0.0)[point]
    stable = (point >= 0) & (angle >= options.min_point_angle_deg)
    lifted, valid = scene.lift(target)
    use = stable | (valid & options.lifting)
    source, target, scores = source[use], target[use], scores[use]
    stable, point = stable[use], point[use]
    points = lifted[use]
    points[stable] = tracks.xyz[point[stable]]
    log_std = np.concatenate([m.keypoint_log_std for m in scene.maps])[target]
    slack = np.where(stable, 0.0, options.depth_deviations * log_std)
    centers = scene.centers()[graph.image_of[target]]
    along = points - centers
    near = centers + along * np.maximum(np.exp(-slack), MIN_DEPTH_SHARE)[:, None]
    far = centers + along * np.exp(slack)[:, None]
    return Correspondences(source, target, points, near, far, graph.image_of[target], scores)


def find_poses(
    scene: Scene,
    image: int,
    found: Correspondences,
    options: RegistrationOptions,
    *,
    seed: int,
    attempt: int,
) -> list[AbsolutePose]:
    """A few distinct poses of an image from its correspondences, best support first.

    While no pose is supported by nearly all matches, more are made from random halves of the
    matches: one wrong match or one bad minimum of few matches does not decide then. ``attempt``
    counts how often the image was tried; each takes other halves, for a few attempts.
    """
    poses: list[AbsolutePose] = []

    def rate(hypotheses: Iterator[Hypothesis]) -> None:
        poses.extend(rate_pose(scene, found, *pose, options) for pose in hypotheses)
        poses.sort(key=lambda pose: -pose.support)

    rate(_hypotheses(scene, image, found, options, seed))
    confident = bool(poses) and poses[0].inlier_share >= options.confident_share
    if options.lifting and not confident and attempt < options.resampled_attempts:
        rate(_resampled_hypotheses(scene, image, found, options, seed + attempt))
    return _distinct(poses)[: options.num_polished]


def _distinct(poses: list[AbsolutePose]) -> list[AbsolutePose]:
    """The poses without those that are turned little from a better one."""
    kept: list[AbsolutePose] = []
    for pose in poses:
        turns = [rotation_angle_deg(pose.rotation @ other.rotation.T) for other in kept]
        if all(turn > MIN_TURN_DEG for turn in turns):
            kept.append(pose)
    return kept


def rate_pose(
    scene: Scene,
    found: Correspondences,
    rotation: Float64,
    translation: Float64,
    source: str,
    options: RegistrationOptions,
) -> AbsolutePose:
    """A pose with the support that the correspondences give it."""
    misfit = _misfits(scene, found, rotation, translation, options)
    inlier = misfit < 1

    def per_reference(values: Float64) -> Float64:
        sums = np.bincount(found.references, values, minlength=scene.num_images)
        return sums.astype(np.float64)

    support = per_reference(found.scores * (1 - misfit**2))
    best = int(np.argmax(support))
    total = per_reference(found.scores)[best]
    return AbsolutePose(
        rotation,
        translation,
        source,
        float(support[best]),
        int(inlier[found.references == best].sum()),
        float(per_reference(found.scores * inlier)[best] / total) if total else 0.0,
    )


def _hypotheses(
    scene: Scene, image: int, found: Correspondences, options: RegistrationOptions, seed: int
) -> Iterator[Hypothesis]:
    """Poses from all correspondences, and from each reference image alone."""
    camera = scene.camera(image)
    xy = scene.keypoints[found.keypoints]
    for factor in PNP_ERROR_FACTORS:
        pose = estimate_absolute_pose(camera, xy, found.points, options, seed, factor)
        if pose:
            yield pose[0], pose[1], "PnP"
    if not options.lifting:
        return
    references = set(found.references.tolist())
    for pair in scene.problem.pairs:
        if image not in (pair.image_a, pair.image_b):
            continue
        reference = pair.image_a if image == pair.image_b else pair.image_b
        if reference not in references:
            continue
        world = scene.rotations[reference], scene.translations[reference]
        for factor in PNP_ERROR_FACTORS:
            reverse = _reverse_pose(scene, image, reference, found, options, seed, factor)
            if reverse:
                yield *compose(invert(*reverse), world), "reverse PnP"
        if pair.calibrated:
            relative = pair.rotation, pair.translation
            if image == pair.image_a:
                relative = invert(*relative)
            length = _baseline(scene, found, reference, relative)
            if length is not None:
                scaled = relative[0], relative[1] * length
                yield *compose(scaled, world), "essential matrix"


def _resampled_hypotheses(
    scene: Scene, image: int, found: Correspondences, options: RegistrationOptions, seed: int
) -> Iterator[Hypothesis]:
    """Poses from random halves of the matches to the image that has most of them.

    A match is drawn in proportion to its score.
    """
    if len(found.keypoints) < MIN_CORRESPONDENCES:
        return
    rng = np.random.default_rng(seed)
    reference = int(np.bincount(found.references).argmax())
    world = scene.rotations[reference], scene.translations[reference]
    mine = np.flatnonzero(found.references == reference)
    half_size = min(max(len(mine) // 2, MIN_CORRESPONDENCES), len(mine))
    odds = found.scores[mine] / found.scores[mine].sum()
    for trial in range(options.num_resamples):
        chosen = rng.choice(mine, half_size, replace=False, p=odds)
        half = Correspondences(*(values[np.sort(chosen)] for values in found))
        factor = PNP_ERROR_FACTORS[trial % len(PNP_ERROR_FACTORS)]
        xy = scene.keypoints[half.keypoints]
        camera = scene.camera(image)
        pose = estimate_absolute_pose(camera, xy, half.points, options, seed, factor, refine=False)
        if pose:
            yield pose[0], pose[1], "PnP"
        reverse = _reverse_pose(scene, image, reference, half, options, seed, factor, refine=False)
        if reverse:
            yield *compose(invert(*reverse), world), "reverse PnP"
        relative = _relative_pose(scene, image, reference, half, options, seed)
        length = _baseline(scene, found, reference, relative) if relative else None
        if relative and length:
            scaled = relative[0], relative[1] * length
            yield *compose(scaled, world), "essential matrix"


def _relative_pose(
    scene: Scene,
    image: int,
    reference: int,
    found: Correspondences,
    options: RegistrationOptions,
    seed: int,
) -> tuple[Float64, Float64] | None:
    """``image_from_reference`` up to its length, by the essential matrix of the matches."""
    result = pycolmap.estimate_essential_matrix(
        scene.keypoints[found.matched],
        scene.keypoints[found.keypoints],
        colmap_camera(scene.camera(reference)),
        colmap_camera(scene.camera(image)),
        pycolmap.RANSACOptions(
            max_error=0.5 * options.max_support_error_px,
            min_inlier_ratio=options.min_inlier_ratio,
            min_num_trials=50,
            max_num_trials=500,  # a half without a good sample is followed by another half
            random_seed=seed,
        ),
    )
    if result is None:
        return None
    pose = result["cam2_from_cam1"]
    return np.array(pose.rotation.matrix()), np.array(pose.translation)


def _reverse_pose(
    scene: Scene,
    image: int,
    reference: int,
    found: Correspondences,
    options: RegistrationOptions,
    seed: int,
    error_factor: float,
    *,
    refine: bool = True,
) -> tuple[Float64, Float64] | None:
    """``reference_from_image`` by PnP on the image's own lifts, at the reference's scale."""
    depth_map = scene.maps[image]
    rows = found.keypoints - scene.graph.offsets[image]
    use = (found.references == reference) & depth_map.keypoint_valid[rows]
    if use.sum() < MIN_CORRESPONDENCES or not depth_map.prior.metric:
        return None
    depth = depth_map.prior_at_keypoints(rows[use]) * scene.maps[reference].scale
    points = scene.rays(found.keypoints[use]) * depth[:, None]
    camera = scene.camera(reference)
    xy = scene.keypoints[found.matched[use]]
    pose = estimate_absolute_pose(camera, xy, points, options, seed, error_factor, refine=refine)
    return (pose[0], pose[1]) if pose else None


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
    """(m,) how far each match is from supporting a pose, in terms of the limits; at most 1."""
    image = scene.graph.image_of[found.keypoints]
    fx, fy, cx, cy = scene.intrinsics[image].T
    xy = scene.keypoints[found.keypoints]
    ends, depths = [], []
    for points in (found.near, found.far):
        camera = points @ rotation.T + translation
        z = np.where(camera[:, 2] > 1e-9, camera[:, 2], np.nan)
        ends.append(np.stack([fx * camera[:, 0] / z + cx, fy * camera[:, 1] / z + cy], axis=1))
        depths.append(z)
    along = ends[1] - ends[0]
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((xy - ends[0]) * along).sum(axis=1) / length, 0, 1)
    distance = np.linalg.norm(ends[0] + share[:, None] * along - xy, axis=1)
    misfits = distance / (options.max_support_error_px * scene.keypoint_std_px[image])
    depth = 1 / ((1 - share) / depths[0] + share / depths[1])
    misfits = np.fmax(misfits, _depth_misfits(scene, found, depth, misfits < 1, options))
    return np.where(misfits < 1, misfits, 1.0)


def _depth_misfits(
    scene: Scene,
    found: Correspondences,
    depth: Float64,
    near: Bool,
    options: RegistrationOptions,
) -> Float64:
    """(m,) how far depths in the new image are from its prior, up to one scale; NaN: unknown."""
    misfits = np.full(len(depth), np.nan)
    if not len(depth):
        return misfits
    image = int(scene.graph.image_of[found.keypoints[0]])
    rows = found.keypoints - scene.graph.offsets[image]
    known = scene.maps[image].keypoint_valid[rows] & (depth > 0)
    if (known & near).any():
        log_ratio = np.log(depth[known] / scene.maps[image].prior_at_keypoints(rows[known]))
        own, other = scene.maps[image].keypoint_log_std[rows[known]], _log_std(scene, found, known)
        limit = options.depth_deviations * np.hypot(own, other)
        misfits[known] = np.abs(log_ratio - np.median(log_ratio[near[known]])) / limit
    return misfits


def _log_std(scene: Scene, found: Correspondences, chosen: Bool) -> Float64:
    """Std of log depth at the matches in the registered images."""
    matched = found.matched[chosen]
    log_std = np.concatenate([m.keypoint_log_std for m in scene.maps])
    at_matches: Float64 = log_std[matched]
    return at_matches
