"""Pose of the next image from triangulated and depth-lifted points (paper section 3.2).

Of many hypotheses the one that most matches support wins, after the best have been moved to where
matches support them most.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.registration.pose_hypotheses import (
    HypothesisEstimator,
    PoseHypothesis,
    PoseHypothesisGenerator,
)
from mpsfm_core.mapping.registration.pose_support import ScoredPose, maximize_support, score_pose
from mpsfm_core.mapping.scene.scene import Scene, Snapshot
from mpsfm_core.mapping.triangulation import triangulate_image
from mpsfm_core.support.threads import allowed

MIN_POSE_DISTANCE_DEG = 3.0
"""PoseHypothesisGenerator that differ less are refined to the same pose (ours)."""


class AbsolutePoseEstimator:
    """Finds poses of images beside the registered ones; leaves the scene as it is."""

    def __init__(self, scene: Scene, refiner: Refiner, options: MapperOptions) -> None:
        self.scene = scene
        self._refiner = refiner
        self._options = options

    def estimate_poses(
        self, image: int, found: PoseCorrespondences, *, attempt: int
    ) -> list[ScoredPose]:
        """A few select_distinct_poses poses, bundle-adjusted beside their neighbours if that finds more support.

        A lone one that nearly all matches support needs none: it is adjusted once registered.
        ``attempt`` counts how often the image was tried: see :func:`estimate_candidate_poses`.
        """
        options = self._options.registration
        poses = self.estimate_unrefined_poses(image, found, attempt=attempt)
        if len(poses) == 1 and poses[0].inlier_ratio >= options.confident_share:
            return poses
        return self.refine_poses(image, poses, found)

    def estimate_unrefined_poses(
        self, image: int, found: PoseCorrespondences, *, attempt: int
    ) -> list[ScoredPose]:
        """The same without bundle adjustment, in half the time."""
        options, seed = self._options.registration, self._options.seed
        return estimate_candidate_poses(
            self.scene, image, found, options, seed=seed, attempt=attempt
        )

    def refine_poses(
        self, image: int, poses: Sequence[ScoredPose], found: PoseCorrespondences
    ) -> list[ScoredPose]:
        """Poses bundle-adjusted beside the image's neighbours, each if that finds more support."""
        snapshot = self.scene.snapshot()
        return [self._refine_pose(image, pose, found, snapshot) for pose in poses]

    def _refine_pose(
        self, image: int, pose: ScoredPose, found: PoseCorrespondences, snapshot: Snapshot
    ) -> ScoredPose:
        scene, options = self.scene, self._options
        scene.register(image, pose.rotation, pose.translation)
        triangulate_image(scene, image, options.triangulation)
        self._refiner.adjust([image], local=True, max_iterations=options.registration.polishing)
        rotation, translation = scene.rotations[image].copy(), scene.translations[image].copy()
        scene.restore(snapshot)
        adjusted = PoseHypothesis(rotation, translation, pose.source)
        polished = score_pose(scene, found, adjusted, options.registration)
        return max(pose, polished, key=lambda candidate: candidate.support)


def estimate_candidate_poses(
    scene: Scene,
    image: int,
    found: PoseCorrespondences,
    options: RegistrationOptions,
    *,
    seed: int,
    attempt: int,
) -> list[ScoredPose]:
    """A few select_distinct_poses poses of an image from its correspondences, best support first.

    While no pose is supported by nearly all matches, more are made from random halves of the
    matches: one wrong match or one bad minimum of few matches does not decide then. ``attempt``
    counts how often the image was tried; each takes other halves, for a few history.
    """
    poses: list[ScoredPose] = []
    hypotheses = PoseHypothesisGenerator(scene, image, found, options, seed)
    with ThreadPoolExecutor(allowed()) as pool:

        def add(estimates: Iterator[HypothesisEstimator]) -> None:
            made = pool.map(lambda estimate: estimate(), estimates)
            rated = [score_pose(scene, found, pose, options) for pose in made if pose]
            chosen = select_distinct_poses(rated, options.num_improved)
            improved = pool.map(partial(maximize_support, scene, found, options=options), chosen)
            poses.extend([*rated, *improved])

        add(hypotheses.generate_from_all())
        best = max(poses, key=lambda pose: pose.support, default=None)
        confident = best is not None and best.inlier_ratio >= options.confident_share
        if options.lifting and not confident and attempt < options.resampled_attempts:
            add(replace(hypotheses, seed=seed + attempt).generate_from_halves())
    return select_distinct_poses(poses, options.num_polished)


def select_distinct_poses(
    poses: Sequence[ScoredPose], count: int | None = None
) -> list[ScoredPose]:
    """The best supported poses, at most ``count``, none turned little from a better one."""
    poses = sorted(poses, key=lambda pose: -pose.support)
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    turns = rotation_angle_deg(rotations[:, None] @ rotations.transpose(0, 2, 1))
    kept: list[int] = []
    for row in range(len(poses)):
        if (turns[row, kept] > MIN_POSE_DISTANCE_DEG).all():
            kept.append(row)
    return [poses[row] for row in kept[:count]]
