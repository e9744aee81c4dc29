"""Pose hypotheses of an image that is to be registered.

A single PnP estimate is not enough: over a wide baseline, points lifted from uncertain depth have
reprojection errors of many pixels. All correspondences score each hypothesis. Hypotheses come from
four sources:

* PnP of the image on the points of the scene, also with unknown focal length,
* reverse PnP: a registered image on the points that the new image lifts from its own depth,
* the essential matrix of a verified pair, with the baseline length from depth,
* the pose that a multi-view network predicts relative to a registered image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, MappingImage, PinholeCamera, Pose
from mpsfm_core.geometry import compose, invert
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_midpoints

MIN_CORRESPONDENCES = 4
"""Correspondences that PnP needs: the minimal sample is three, the fourth selects the solution."""
PNP_CONFIDENCE = 0.99999
"""Confidence of the RANSAC of PnP. [COLMAP, reference]"""
PNP_TRIALS = (100, 10_000)
"""Smallest and largest number of RANSAC trials of PnP. [COLMAP, reference]"""
ESSENTIAL_TRIALS = (50, 500)
"""The same for the essential matrix: few, because other subsets of the matches follow. [ours]"""
FOCAL_RANGE = (0.4, 10.0)
"""Smallest and largest focal length to try, over the longer side of the image. [ours]"""
MAX_FOCAL_DEVIATION = 3.0
"""Largest deviation of a focal length to try, in standard deviations of its prior. [ours]"""
MAX_FOCAL_CORRESPONDENCES = 200
"""About how many correspondences choose between focal lengths; raising it is slower. [ours]"""
FOCAL_STEP = 1.2
"""Largest ratio of consecutive focal lengths to try. PnP tolerates half of such a step. [ours]"""


class PoseHypothesis(NamedTuple):
    """Candidate pose of an image."""

    rotation: Float64
    """(3, 3) ``cam_from_world``."""
    translation: Float64
    """(3,) ``cam_from_world``."""
    source: str
    """Name of the estimator."""
    focal_px: float | None = None
    """``fx`` that was estimated with the pose; None for that of the scene."""


HypothesisEstimator = Callable[[], PoseHypothesis | None]
"""Estimates one hypothesis; COLMAP's estimators release the GIL."""


def estimate_absolute_pose(
    camera: PinholeCamera,
    xy: Float64,
    points: Float64,
    options: RegistrationOptions,
    seed: int,
    *,
    refine: bool = True,
) -> tuple[Float64, Float64, Bool] | None:
    """Estimate an absolute pose by PnP in LO-RANSAC (pycolmap).

    Args:
        camera: Camera of the image.
        xy: (m, 2) keypoints in pixels.
        points: (m, 3) world points.
        options: ``max_error_px`` and ``min_inlier_ratio`` apply.
        seed: Seed of RANSAC.
        refine: Minimize the reprojection error of the inliers afterwards.

    Returns:
        Rotation and translation ``cam_from_world`` and the inlier mask (m,), or None if it fails.
    """
    if len(xy) < MIN_CORRESPONDENCES:
        return None
    result = _run_pnp_ransac(colmap_from_pinhole(camera), xy, points, options, seed, refine=refine)
    if result is None:
        return None
    rotation, translation = _pose_from_rigid3d(result["cam_from_world"])
    return rotation, translation, np.asarray(result["inlier_mask"], dtype=np.bool_)


def sample_focal_lengths(image: MappingImage) -> Float64:
    """Sample focal lengths to try for an image, on a logarithmic grid around its prior.

    Args:
        image: The image; ``focal_prior_px`` and ``focal_log_std`` are its prior.

    Returns:
        (m,) ``fx`` in pixels, ascending, within ``MAX_FOCAL_DEVIATION`` and ``FOCAL_RANGE``.
    """
    prior_px, reach = image.focal_prior_px, MAX_FOCAL_DEVIATION * image.focal_log_std
    min_px, max_px = np.array(FOCAL_RANGE) * max(image.camera.size)
    min_px = max(min_px, prior_px * np.exp(-reach))
    max_px = min(max_px, prior_px * np.exp(reach))
    if not min_px < max_px:
        return np.array([prior_px])
    num_steps = int(np.ceil(np.log(max_px / min_px) / np.log(FOCAL_STEP)))
    return np.geomspace(min_px, max_px, 1 + num_steps)


def _run_pnp_ransac(
    camera: pycolmap.Camera,
    xy: Float64,
    points: Float64,
    options: RegistrationOptions,
    seed: int,
    *,
    refine: bool,
) -> dict[str, Any] | None:
    """Run COLMAP's PnP in LO-RANSAC; None if it fails."""
    min_trials, max_trials = PNP_TRIALS
    ransac = pycolmap.RANSACOptions(
        max_error=options.max_error_px,
        min_inlier_ratio=options.min_inlier_ratio,
        confidence=PNP_CONFIDENCE,
        min_num_trials=min_trials,
        max_num_trials=max_trials,
        random_seed=seed,
    )
    estimate = (
        pycolmap.estimate_and_refine_absolute_pose if refine else pycolmap.estimate_absolute_pose
    )
    result: dict[str, Any] | None = estimate(
        xy, points, camera, pycolmap.AbsolutePoseEstimationOptions(ransac=ransac)
    )
    return result


def _pose_from_rigid3d(pose: pycolmap.Rigid3d) -> Pose:
    """Convert a pose of COLMAP to rotation matrix and translation."""
    return (
        np.asarray(pose.rotation.matrix(), dtype=np.float64),
        np.asarray(pose.translation, dtype=np.float64),
    )


@dataclass(frozen=True, eq=False)
class PoseHypothesisGenerator:
    """Generator of pose hypotheses of one image from its correspondences."""

    scene: Scene
    """The scene with the registered images."""
    image: int
    """The image to register."""
    correspondences: PoseCorrespondences
    """2D-3D correspondences of the image."""
    options: RegistrationOptions
    """Thresholds and number of resamples."""
    seed: int
    """Seed of RANSAC and of the resampling."""

    def generate_from_all(self) -> Iterator[HypothesisEstimator]:
        """Generate estimators that use all matches, and all matches of each reference image."""
        yield self._estimate_pnp
        if self.options.estimate_focal and self.scene.has_free_focal(self.image):
            yield self._estimate_pnp_with_focal
        if not self.options.lifting:
            return
        references = set(self.correspondences.references.tolist())
        for pair in self.scene.graph.pairs_of[self.image]:
            reference = pair.image_a if self.image == pair.image_b else pair.image_b
            if reference not in references:
                continue
            yield partial(self._estimate_reverse_pnp, reference)
            if pair.calibrated:
                relative = pair.rotation, pair.translation
                if self.image == pair.image_a:
                    relative = invert(*relative)
                yield partial(self._scale_relative_pose, self.correspondences, reference, relative)
            yield partial(self._use_network_pose, reference)

    def generate_from_halves(self) -> Iterator[HypothesisEstimator]:
        """Generate estimators that use random halves of the matches to the best reference image.

        The best reference image has the most correspondences. The probability of drawing a match is
        proportional to its weight.
        """
        correspondences = self.correspondences
        if len(correspondences.keypoints) < MIN_CORRESPONDENCES:
            return
        rng = np.random.default_rng(self.seed)
        reference = int(np.bincount(correspondences.references).argmax())
        rows = np.flatnonzero(correspondences.references == reference)
        num_sampled = min(max(len(rows) // 2, MIN_CORRESPONDENCES), len(rows))
        probabilities = correspondences.weights[rows] / correspondences.weights[rows].sum()
        for _ in range(self.options.num_resamples):
            sampled = np.sort(rng.choice(rows, num_sampled, replace=False, p=probabilities))
            half = replace(self, correspondences=correspondences.select(sampled))
            yield half._estimate_pnp
            yield partial(half._estimate_reverse_pnp, reference)
            yield partial(half._estimate_from_essential_matrix, correspondences, reference)

    def _estimate_pnp(self) -> PoseHypothesis | None:
        """Estimate the pose by PnP on the points of the scene."""
        correspondences = self.correspondences.select(self.correspondences.depth_known)
        xy = self.scene.keypoints[correspondences.keypoints]
        pose = self._solve_pnp(self.image, xy, correspondences.points)
        return PoseHypothesis(*pose, "PnP") if pose else None

    def _estimate_pnp_with_focal(self) -> PoseHypothesis | None:
        """Estimate pose and focal length by PnP on points that calibrated cameras triangulated.

        PnP runs with each focal length of a logarithmic grid. The one with most inliers is refined
        together with its pose.
        """
        scene, options, correspondences = self.scene, self.options, self.correspondences
        is_determined = scene.has_determined_focal(correspondences.references)
        correspondences = correspondences.select(correspondences.triangulated & is_determined)
        count = len(correspondences.keypoints)
        if count < options.min_inliers:
            return None
        step = max(1, count // MAX_FOCAL_CORRESPONDENCES)
        correspondences = correspondences.select(np.arange(0, count, step))
        xy, points = scene.keypoints[correspondences.keypoints], correspondences.points
        pinhole = scene.camera(self.image)
        focal_lengths = sample_focal_lengths(scene.problem.images[self.image])
        best: tuple[pycolmap.Camera, dict[str, Any]] | None = None
        for focal_px in focal_lengths:
            camera = colmap_from_pinhole(
                replace(pinhole, fx=focal_px, fy=focal_px * pinhole.fy / pinhole.fx)
            )
            result = _run_pnp_ransac(camera, xy, points, options, self.seed, refine=False)
            if result and (best is None or result["num_inliers"] > best[1]["num_inliers"]):
                best = camera, result
        if best is None:
            return None
        camera, result = best
        refined = pycolmap.refine_absolute_pose(
            result["cam_from_world"],
            xy,
            points,
            result["inlier_mask"],
            camera,
            pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=True),
        )
        min_px, max_px = focal_lengths[[0, -1]] * [1 / FOCAL_STEP, FOCAL_STEP]
        focal_px = float(camera.params[0])  # the refinement changes the camera
        if refined is None or not min_px <= focal_px <= max_px:
            return None
        pose = _pose_from_rigid3d(refined["cam_from_world"])
        return PoseHypothesis(*pose, "PnP with unknown focal length", focal_px)

    def _estimate_reverse_pnp(self, reference: int) -> PoseHypothesis | None:
        """Estimate the pose of the reference by PnP on points lifted from the image's own prior.

        The prior has the scale of the reference's prior, so it must be metric.
        """
        scene, correspondences = self.scene, self.correspondences
        depth_map = scene.maps[self.image]
        rows = correspondences.keypoints - scene.graph.offsets[self.image]
        usable = (correspondences.references == reference) & depth_map.keypoint_valid[rows]
        if usable.sum() < MIN_CORRESPONDENCES or not depth_map.prior.metric:
            return None
        depth = depth_map.prior_at_keypoints(rows[usable]) * scene.maps[reference].scale
        points = scene.rays(correspondences.keypoints[usable]) * depth[:, None]
        xy = scene.keypoints[correspondences.matched_keypoints[usable]]
        pose = self._solve_pnp(reference, xy, points)
        return self._to_world(reference, invert(*pose), "reverse PnP") if pose else None

    def _estimate_from_essential_matrix(
        self, depth_correspondences: PoseCorrespondences, reference: int
    ) -> PoseHypothesis | None:
        """Estimate the essential matrix; the depth of further matches gives the baseline length."""
        scene, correspondences = self.scene, self.correspondences
        min_trials, max_trials = ESSENTIAL_TRIALS
        result = pycolmap.estimate_essential_matrix(
            scene.keypoints[correspondences.matched_keypoints],
            scene.keypoints[correspondences.keypoints],
            colmap_from_pinhole(scene.camera(reference)),
            colmap_from_pinhole(scene.camera(self.image)),
            pycolmap.RANSACOptions(
                max_error=0.5 * self.options.max_support_error_px,
                min_inlier_ratio=self.options.min_inlier_ratio,
                min_num_trials=min_trials,
                max_num_trials=max_trials,
                random_seed=self.seed,
            ),
        )
        if result is None:
            return None
        pose = result["cam2_from_cam1"]
        relative = np.array(pose.rotation.matrix()), np.array(pose.translation)
        return self._scale_relative_pose(depth_correspondences, reference, relative)

    def _scale_relative_pose(
        self, depth_correspondences: PoseCorrespondences, reference: int, relative: Pose
    ) -> PoseHypothesis | None:
        """Scale a pose relative to the reference by known depth, and convert it to the world."""
        length = _estimate_baseline(self.scene, depth_correspondences, reference, relative)
        if not length:
            return None
        return self._to_world(reference, (relative[0], relative[1] * length), "essential matrix")

    def _use_network_pose(self, reference: int) -> PoseHypothesis | None:
        """Use the pose that a multi-view network predicts relative to the reference.

        Both images must belong to one group of the network, which has one frame and one unit.
        """
        scene = self.scene
        images, depth_map = scene.problem.images, scene.maps[reference]
        image_pose = images[self.image].proposed_pose
        reference_pose = images[reference].proposed_pose
        same_group = scene.depth_group_of[self.image] == scene.depth_group_of[reference]
        if image_pose is None or reference_pose is None or not same_group or not depth_map.active:
            return None
        rotation, translation = compose(image_pose, invert(*reference_pose))
        relative = rotation, depth_map.scale * translation
        return self._to_world(reference, relative, "multi-view network")

    def _to_world(self, reference: int, relative: Pose, source: str) -> PoseHypothesis:
        """Convert a pose relative to a registered image to ``cam_from_world``."""
        world = self.scene.rotations[reference], self.scene.translations[reference]
        return PoseHypothesis(*compose(relative, world), source)

    def _solve_pnp(self, image: int, xy: Float64, points: Float64) -> Pose | None:
        camera, options = self.scene.camera(image), self.options
        pose = estimate_absolute_pose(camera, xy, points, options, self.seed, refine=False)
        return (pose[0], pose[1]) if pose else None


def _estimate_baseline(
    scene: Scene, correspondences: PoseCorrespondences, reference: int, relative: Pose
) -> float | None:
    """Return the scale of a relative translation that fits triangulated points to known depth.

    The scale is the median ratio of known depth to triangulated depth in the reference camera.
    """
    rows = (correspondences.references == reference) & correspondences.depth_known
    rotation, translation = relative
    world_points = correspondences.points[rows]
    points = world_points @ scene.rotations[reference].T + scene.translations[reference]
    rays_a = points / points[:, 2:]
    rays_b = scene.rays(correspondences.keypoints[rows]) @ rotation
    center_b = -rotation.T @ translation
    z = triangulate_midpoints(np.zeros(3), rays_a, center_b, rays_b)[:, 2]
    with np.errstate(invalid="ignore"):
        in_front = (z > 0) & (points[:, 2] > 0)
    return float(np.median(points[in_front, 2] / z[in_front])) if in_front.any() else None
