"""Absolute pose estimation of an image (paper section 3.2).

Many pose hypotheses are generated and scored by their support. The best distinct hypotheses are
refined to maximize their support, and a few of the refined poses are refined by local bundle
adjustment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from mpsfm_core.geometry import compose, invert, rotation_angle_deg
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.registration.pose_hypotheses import (
    HypothesisEstimator,
    PoseHypothesis,
    PoseHypothesisGenerator,
)
from mpsfm_core.mapping.registration.pose_support import (
    CONFIDENT_INLIER_RATIO,
    ScoredPose,
    maximize_support,
    score_pose,
)
from mpsfm_core.mapping.registration.reverse_correspondences import (
    find_reverse_reference,
    reverse_registration,
)
from mpsfm_core.mapping.scene.scene import Scene, Snapshot
from mpsfm_core.mapping.triangulation import triangulate_image
from mpsfm_core.support.threads import thread_limit

NUM_BUNDLE_ADJUSTED = 3
"""Number of distinct pose hypotheses that bundle adjustment refines before the best hypothesis is
selected. [ours]"""
MAX_BUNDLE_ITERATIONS = 10
"""Maximum number of iterations of the bundle adjustment of a pose hypothesis. [ours]"""
MIN_POSE_DISTANCE_DEG = 3.0
"""Smallest angle between the rotations of distinct poses; closer poses converge to the same pose.
[ours]"""
MIN_FOCAL_SUPPORT_RATIO = 1.05
"""Smallest ratio between the support with an estimated and with a guessed focal length. An
additional parameter always increases the support a little. [ours]"""


class AbsolutePoseEstimator:
    """Estimator of absolute poses of images, which leaves the scene unchanged."""

    def __init__(self, scene: Scene, refiner: Refiner, options: MapperOptions) -> None:
        self.scene = scene
        self._refiner = refiner
        self._options = options

    def estimate_poses(
        self, correspondences: PoseCorrespondences, *, attempt: int
    ) -> list[ScoredPose]:
        """Estimate a few distinct poses of an image and refine them by bundle adjustment.

        A single pose with a high inlier ratio is returned without bundle adjustment, because
        registration runs bundle adjustment anyway.

        Args:
            correspondences: 2D-3D correspondences of the image to register and of its frame.
            attempt: Number of earlier registration attempts of the image (see
                :func:`estimate_candidate_poses`).
        """
        poses = self.estimate_unrefined_poses(correspondences, attempt=attempt)
        if len(poses) == 1 and poses[0].inlier_ratio >= CONFIDENT_INLIER_RATIO:
            return poses
        return self.refine_poses(poses, correspondences)

    def estimate_unrefined_poses(
        self, correspondences: PoseCorrespondences, *, attempt: int
    ) -> list[ScoredPose]:
        """Estimate a few distinct poses of an image without bundle adjustment."""
        options, seed = self._options.registration, self._options.seed
        if not self._options.refinement.refine_focal:
            options = options.model_copy(update={"estimate_focal": False})
        estimate = partial(estimate_candidate_poses, options=options, seed=seed, attempt=attempt)
        poses = estimate(self.scene, correspondences)
        image = correspondences.image
        reference = find_reverse_reference(self.scene, correspondences)
        if reference is None:
            return poses
        with reverse_registration(self.scene, image, reference, options) as reverse:
            reverse_poses = estimate(self.scene, reverse)
        poses += [self._from_reverse(pose, reference) for pose in reverse_poses]
        return select_distinct_poses(poses, NUM_BUNDLE_ADJUSTED)

    def score_pose(
        self, correspondences: PoseCorrespondences, hypothesis: PoseHypothesis
    ) -> ScoredPose:
        """Compute the support of a pose by the depth of the registered or of the new frame.

        Args:
            correspondences: 2D-3D correspondences of the image to register and of its frame.
            hypothesis: The pose of the image.
        """
        scene, options = self.scene, self._options.registration
        scored = score_pose(scene, correspondences, hypothesis, options)
        image, reference = correspondences.image, find_reverse_reference(scene, correspondences)
        if reference is None:
            return scored
        world = scene.rotations[reference].copy(), scene.translations[reference].copy()
        pose = compose(world, invert(hypothesis.rotation, hypothesis.translation))
        reverse_hypothesis = PoseHypothesis(*pose, hypothesis.source)
        with reverse_registration(scene, image, reference, options) as reverse:
            reverse_scored = score_pose(scene, reverse, reverse_hypothesis, options)
        reverse_scored = self._from_reverse(reverse_scored, reference)
        return max(scored, reverse_scored, key=lambda candidate: candidate.support)

    def _from_reverse(self, scored: ScoredPose, reference: int) -> ScoredPose:
        """Return the pose of a new image from the pose of a registered image relative to it."""
        world = self.scene.rotations[reference], self.scene.translations[reference]
        rotation, translation = compose(invert(scored.rotation, scored.translation), world)
        return replace(scored, rotation=rotation, translation=translation)

    def refine_poses(
        self, poses: Sequence[ScoredPose], correspondences: PoseCorrespondences
    ) -> list[ScoredPose]:
        """Refine poses by bundle adjustment, except poses that lose support."""
        snapshot = self.scene.snapshot()
        return [self._refine_pose(pose, correspondences, snapshot) for pose in poses]

    def _refine_pose(
        self, pose: ScoredPose, correspondences: PoseCorrespondences, snapshot: Snapshot
    ) -> ScoredPose:
        scene, options, image = self.scene, self._options, correspondences.image
        scene.register(image, pose.rotation, pose.translation, pose.focal_px)
        for member in scene.rigs.images_of(image):
            triangulate_image(scene, member, options.triangulation)
        self._refiner.adjust([image], local=True, max_iterations=MAX_BUNDLE_ITERATIONS)
        rotation, translation = scene.rotations[image].copy(), scene.translations[image].copy()
        scene.restore(snapshot)
        adjusted = PoseHypothesis(rotation, translation, pose.source, pose.focal_px)
        refined = self.score_pose(correspondences, adjusted)
        return max(pose, refined, key=lambda candidate: candidate.support)


def estimate_candidate_poses(
    scene: Scene,
    correspondences: PoseCorrespondences,
    options: RegistrationOptions,
    *,
    seed: int,
    attempt: int,
) -> list[ScoredPose]:
    """Estimate a few distinct poses of an image, best support first.

    If no pose has a high inlier ratio, random halves of the matches give further hypotheses.
    Hypotheses from random halves of the matches escape a single wrong match and poor local minima.

    Args:
        scene: The scene with the registered images.
        correspondences: 2D-3D correspondences of the image to register and of its frame.
        options: Inlier thresholds and numbers of pose hypotheses.
        seed: Seed of RANSAC.
        attempt: Number of earlier registration attempts of the image. Each of the first
            ``max_resampled_attempts`` attempts draws other halves of the matches, and later
            attempts draw no halves.
    """
    poses: list[ScoredPose] = []
    generator = PoseHypothesisGenerator(scene, correspondences, options, seed)
    with ThreadPoolExecutor(thread_limit()) as pool:

        def add_poses(estimators: Iterator[HypothesisEstimator]) -> None:
            hypotheses = pool.map(lambda estimate: estimate(), estimators)
            scored = [score_pose(scene, correspondences, h, options) for h in hypotheses if h]
            scored = _discard_needless_focals(scored)
            distinct = select_distinct_poses(scored, options.num_locally_optimized)
            maximize = partial(maximize_support, scene, correspondences, options=options)
            poses.extend([*scored, *pool.map(maximize, distinct)])

        add_poses(generator.generate_from_all())
        best = max(poses, key=lambda pose: pose.support, default=None)
        is_confident = best is not None and best.inlier_ratio >= CONFIDENT_INLIER_RATIO
        if options.lifting and not is_confident and attempt < options.max_resampled_attempts:
            add_poses(replace(generator, seed=seed + attempt).generate_from_halves())
    return select_distinct_poses(poses, NUM_BUNDLE_ADJUSTED)


def _discard_needless_focals(poses: Sequence[ScoredPose]) -> list[ScoredPose]:
    """Discard poses whose estimated focal length hardly increases the support of the pose."""
    support = max((pose.support for pose in poses if pose.focal_px is None), default=0.0)
    min_support = MIN_FOCAL_SUPPORT_RATIO * support
    return [pose for pose in poses if pose.focal_px is None or pose.support > min_support]


def select_distinct_poses(
    poses: Sequence[ScoredPose], max_poses: int | None = None
) -> list[ScoredPose]:
    """Return the best supported poses with rotations that differ from all better poses."""
    poses = sorted(poses, key=lambda pose: -pose.support)
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    angles_deg = rotation_angle_deg(rotations[:, None] @ rotations.transpose(0, 2, 1))
    distinct: list[int] = []
    for row in range(len(poses)):
        if (angles_deg[row, distinct] > MIN_POSE_DISTANCE_DEG).all():
            distinct.append(row)
    return [poses[row] for row in distinct[:max_poses]]
