"""Pose of the next image from triangulated and depth-lifted points (paper section 3.2).

Of many hypotheses the one that most matches support wins. A match supports a pose if its keypoint
lies near the segment onto which the other keypoint's ray projects between the depths that the prior
allows, and if the depth that follows fits the new image's own prior.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from mpsfm_core.data import Bool, Float64
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.correspondences import Correspondences
from mpsfm_core.mapping.options import THREADS, MapperOptions, RegistrationOptions
from mpsfm_core.mapping.pose_hypotheses import Estimate, Hypotheses, Hypothesis
from mpsfm_core.mapping.refinement import Refiner
from mpsfm_core.mapping.triangulation import triangulate_image
from mpsfm_core.scene.scene import Scene, Snapshot

MIN_TURN_DEG = 3.0
"""Hypotheses that differ less are refined to the same pose (ours)."""


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

    @property
    def hypothesis(self) -> Hypothesis:
        """The pose alone, to be rated again."""
        return Hypothesis(self.rotation, self.translation, self.source)


class PoseSearch:
    """Finds poses of images beside the registered ones; leaves the scene as it is."""

    def __init__(self, scene: Scene, refiner: Refiner, options: MapperOptions) -> None:
        self.scene = scene
        self._refiner = refiner
        self._options = options

    def poses(self, image: int, found: Correspondences, *, attempt: int) -> list[AbsolutePose]:
        """A few distinct poses, bundle-adjusted beside their neighbours if that finds more support.

        ``attempt`` counts how often the image was tried: see :func:`find_poses`.
        """
        options, seed = self._options.registration, self._options.seed
        poses = find_poses(self.scene, image, found, options, seed=seed, attempt=attempt)
        snapshot = self.scene.snapshot()
        return [self._polished(image, pose, found, snapshot) for pose in poses]

    def _polished(
        self, image: int, pose: AbsolutePose, found: Correspondences, snapshot: Snapshot
    ) -> AbsolutePose:
        scene, options = self.scene, self._options
        scene.register(image, pose.rotation, pose.translation)
        triangulate_image(scene, image, options.triangulation)
        self._refiner.adjust([image], local=True, max_iterations=options.registration.polishing)
        rotation, translation = scene.rotations[image].copy(), scene.translations[image].copy()
        scene.restore(snapshot)
        adjusted = Hypothesis(rotation, translation, pose.source)
        polished = rate_pose(scene, found, adjusted, options.registration)
        return max(pose, polished, key=lambda candidate: candidate.support)


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
    hypotheses = Hypotheses(scene, image, found, options, seed)
    with ThreadPoolExecutor(THREADS) as pool:

        def rate(estimates: Iterator[Estimate]) -> None:
            made = pool.map(lambda estimate: estimate(), estimates)
            poses.extend(rate_pose(scene, found, pose, options) for pose in made if pose)
            poses.sort(key=lambda pose: -pose.support)

        rate(hypotheses.of_all())
        confident = bool(poses) and poses[0].inlier_share >= options.confident_share
        if options.lifting and not confident and attempt < options.resampled_attempts:
            rate(replace(hypotheses, seed=seed + attempt).of_halves())
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
    hypothesis: Hypothesis,
    options: RegistrationOptions,
) -> AbsolutePose:
    """A pose with the support that the correspondences give it."""
    misfit = _misfits(scene, found, hypothesis, options)
    inlier = misfit < 1

    def per_reference(values: Float64) -> Float64:
        sums = np.bincount(found.references, values, minlength=scene.num_images)
        return sums.astype(np.float64)

    support = per_reference(found.scores * (1 - misfit**2))
    best = int(np.argmax(support))
    total = per_reference(found.scores)[best]
    return AbsolutePose(
        *hypothesis,
        float(support[best]),
        int(inlier[found.references == best].sum()),
        float(per_reference(found.scores * inlier)[best] / total) if total else 0.0,
    )


def _misfits(
    scene: Scene,
    found: Correspondences,
    pose: Hypothesis,
    options: RegistrationOptions,
) -> Float64:
    """(m,) how far each match is from supporting a pose, in terms of the limits; at most 1."""
    image = scene.graph.image_of[found.keypoints]
    fx, fy, cx, cy = scene.intrinsics[image].T
    xy = scene.keypoints[found.keypoints]
    ends, depths = [], []
    for points in (found.near, found.far):
        camera = points @ pose.rotation.T + pose.translation
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
        own = scene.keypoint_log_std[found.keypoints[known]]
        other = scene.keypoint_log_std[found.matched[known]]
        limit = options.depth_deviations * np.hypot(own, other)
        misfits[known] = np.abs(log_ratio - np.median(log_ratio[near[known]])) / limit
    return misfits
