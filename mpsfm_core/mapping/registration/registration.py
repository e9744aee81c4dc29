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
from mpsfm_core.mapping.registration.correspondences import Correspondences
from mpsfm_core.mapping.registration.pose_hypotheses import Estimate, Hypotheses, Hypothesis
from mpsfm_core.mapping.registration.pose_support import AbsolutePose, improve_pose, rate_pose
from mpsfm_core.mapping.scene.scene import Scene, Snapshot
from mpsfm_core.mapping.triangulation import triangulate_image
from mpsfm_core.support.threads import allowed

MIN_TURN_DEG = 3.0
"""Hypotheses that differ less are refined to the same pose (ours)."""


class PoseSearch:
    """Finds poses of images beside the registered ones; leaves the scene as it is."""

    def __init__(self, scene: Scene, refiner: Refiner, options: MapperOptions) -> None:
        self.scene = scene
        self._refiner = refiner
        self._options = options

    def poses(self, image: int, found: Correspondences, *, attempt: int) -> list[AbsolutePose]:
        """A few distinct poses, bundle-adjusted beside their neighbours if that finds more support.

        A lone one that nearly all matches support needs none: it is adjusted once registered.
        ``attempt`` counts how often the image was tried: see :func:`find_poses`.
        """
        options = self._options.registration
        poses = self.rough_poses(image, found, attempt=attempt)
        if len(poses) == 1 and poses[0].inlier_share >= options.confident_share:
            return poses
        return self.polished(image, poses, found)

    def rough_poses(
        self, image: int, found: Correspondences, *, attempt: int
    ) -> list[AbsolutePose]:
        """The same without bundle adjustment, in half the time."""
        options, seed = self._options.registration, self._options.seed
        return find_poses(self.scene, image, found, options, seed=seed, attempt=attempt)

    def polished(
        self, image: int, poses: Sequence[AbsolutePose], found: Correspondences
    ) -> list[AbsolutePose]:
        """Poses bundle-adjusted beside the image's neighbours, each if that finds more support."""
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
    with ThreadPoolExecutor(allowed()) as pool:

        def add(estimates: Iterator[Estimate]) -> None:
            made = pool.map(lambda estimate: estimate(), estimates)
            rated = [rate_pose(scene, found, pose, options) for pose in made if pose]
            chosen = distinct(rated, options.num_improved)
            improved = pool.map(partial(improve_pose, scene, found, options=options), chosen)
            poses.extend([*rated, *improved])

        add(hypotheses.of_all())
        best = max(poses, key=lambda pose: pose.support, default=None)
        confident = best is not None and best.inlier_share >= options.confident_share
        if options.lifting and not confident and attempt < options.resampled_attempts:
            add(replace(hypotheses, seed=seed + attempt).of_halves())
    return distinct(poses, options.num_polished)


def distinct(poses: Sequence[AbsolutePose], count: int | None = None) -> list[AbsolutePose]:
    """The best supported poses, at most ``count``, none turned little from a better one."""
    poses = sorted(poses, key=lambda pose: -pose.support)
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    turns = rotation_angle_deg(rotations[:, None] @ rotations.transpose(0, 2, 1))
    kept: list[int] = []
    for row in range(len(poses)):
        if (turns[row, kept] > MIN_TURN_DEG).all():
            kept.append(row)
    return [poses[row] for row in kept[:count]]
