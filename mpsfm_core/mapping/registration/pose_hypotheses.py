"""Possible poses of a new image: hypotheses, each to be judged by all matches.

Lifted points of an uncertain depth miss by many pixels over a wide baseline, so one PnP is not
enough. PoseHypothesisGenerator come from PnP on the points of the scene, from PnP the other way round (the new
image's own lifts seen in a registered image), and from the essential matrices of verified pairs
with the length that depth gives them, and from what a network that saw several photos at once
proposes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, PinholeCamera, Pose
from mpsfm_core.geometry import compose, invert
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import PoseCorrespondences
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_midpoints

MIN_CORRESPONDENCES = 4
"""PnP needs three; the fourth chooses among the solutions."""


class PoseHypothesis(NamedTuple):
    """``cam_from_world`` of an image, and where it comes from."""

    rotation: Float64
    translation: Float64
    source: str


HypothesisEstimator = Callable[[], PoseHypothesis | None]
"""Makes a hypothesis; COLMAP's estimators let other threads work meanwhile."""


def estimate_absolute_pose(
    camera: PinholeCamera,
    xy: Float64,
    points: Float64,
    options: RegistrationOptions,
    seed: int,
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
        max_error=options.max_error_px,
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
        colmap_from_pinhole(camera),
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


@dataclass(frozen=True, eq=False)
class PoseHypothesisGenerator:
    """The estimators of an image's pose on some correspondences."""

    scene: Scene
    image: int
    found: PoseCorrespondences
    options: RegistrationOptions
    seed: int

    def generate_from_all(self) -> Iterator[HypothesisEstimator]:
        """From all correspondences, and from each reference image alone."""
        yield self._forward
        if not self.options.lifting:
            return
        references = set(self.found.references.tolist())
        for pair in self.scene.graph.pairs_of[self.image]:
            reference = pair.image_a if self.image == pair.image_b else pair.image_b
            if reference not in references:
                continue
            yield partial(self._reverse, reference)
            if pair.calibrated:
                relative = pair.rotation, pair.translation
                if self.image == pair.image_a:
                    relative = invert(*relative)
                yield partial(self._scaled, self.found, reference, relative)
            yield partial(self._proposed, reference)

    def generate_from_halves(self) -> Iterator[HypothesisEstimator]:
        """From random halves of the matches to the image that has most of them.

        A match is drawn in proportion to its weight.
        """
        found = self.found
        if len(found.keypoints) < MIN_CORRESPONDENCES:
            return
        rng = np.random.default_rng(self.seed)
        reference = int(np.bincount(found.references).argmax())
        mine = np.flatnonzero(found.references == reference)
        half_size = min(max(len(mine) // 2, MIN_CORRESPONDENCES), len(mine))
        odds = found.weights[mine] / found.weights[mine].sum()
        for _ in range(self.options.num_resamples):
            chosen = np.sort(rng.choice(mine, half_size, replace=False, p=odds))
            half = replace(self, found=found.select(chosen))
            yield half._forward
            yield partial(half._reverse, reference)
            yield partial(half._essential, found, reference)

    def _forward(self) -> PoseHypothesis | None:
        """PnP on the points of the scene."""
        found = self.found.select(self.found.known)
        pose = self._pnp(self.image, self.scene.keypoints[found.keypoints], found.points)
        return PoseHypothesis(*pose, "PnP") if pose else None

    def _reverse(self, reference: int) -> PoseHypothesis | None:
        """PnP of the reference on the image's own lifts, at the reference's scale."""
        scene, found = self.scene, self.found
        depth_map = scene.maps[self.image]
        rows = found.keypoints - scene.graph.offsets[self.image]
        use = (found.references == reference) & depth_map.keypoint_valid[rows]
        if use.sum() < MIN_CORRESPONDENCES or not depth_map.prior.metric:
            return None
        depth = depth_map.prior_at_keypoints(rows[use]) * scene.maps[reference].scale
        points = scene.rays(found.keypoints[use]) * depth[:, None]
        xy = scene.keypoints[found.matched[use]]
        pose = self._pnp(reference, xy, points)
        return self._placed(reference, invert(*pose), "reverse PnP") if pose else None

    def _essential(self, judges: PoseCorrespondences, reference: int) -> PoseHypothesis | None:
        """The essential matrix of the matches, its length by the depth of the ``judges``."""
        scene, found = self.scene, self.found
        result = pycolmap.estimate_essential_matrix(
            scene.keypoints[found.matched],
            scene.keypoints[found.keypoints],
            colmap_from_pinhole(scene.camera(reference)),
            colmap_from_pinhole(scene.camera(self.image)),
            pycolmap.RANSACOptions(
                max_error=0.5 * self.options.max_support_error_px,
                min_inlier_ratio=self.options.min_inlier_ratio,
                min_num_trials=50,
                max_num_trials=500,  # a half without a good sample is followed by another half
                random_seed=self.seed,
            ),
        )
        if result is None:
            return None
        pose = result["cam2_from_cam1"]
        relative = np.array(pose.rotation.matrix()), np.array(pose.translation)
        return self._scaled(judges, reference, relative)

    def _scaled(
        self, judges: PoseCorrespondences, reference: int, relative: Pose
    ) -> PoseHypothesis | None:
        """A pose relative to a reference, known up to its length."""
        length = _baseline(self.scene, judges, reference, relative)
        if not length:
            return None
        return self._placed(reference, (relative[0], relative[1] * length), "essential matrix")

    def _proposed(self, reference: int) -> PoseHypothesis | None:
        """As the image lies to the reference in the frame of the group that both are of."""
        scene = self.scene
        images, depth_map = scene.problem.images, scene.maps[reference]
        own, other = images[self.image].proposed_pose, images[reference].proposed_pose
        same = scene.depth_group_of[self.image] == scene.depth_group_of[reference]
        if own is None or other is None or not same or not depth_map.active:
            return None
        rotation, translation = compose(own, invert(*other))
        relative = rotation, depth_map.scale * translation
        return self._placed(reference, relative, "multi-view network")

    def _placed(self, reference: int, relative: Pose, source: str) -> PoseHypothesis:
        """A pose relative to a reference as one in the world."""
        world = self.scene.rotations[reference], self.scene.translations[reference]
        return PoseHypothesis(*compose(relative, world), source)

    def _pnp(self, image: int, xy: Float64, points: Float64) -> Pose | None:
        camera, options = self.scene.camera(image), self.options
        pose = estimate_absolute_pose(camera, xy, points, options, self.seed, refine=False)
        return (pose[0], pose[1]) if pose else None


def _baseline(
    scene: Scene, found: PoseCorrespondences, reference: int, relative: Pose
) -> float | None:
    """Factor of a relative translation that brings triangulated points to the known depth."""
    mine = (found.references == reference) & found.known
    rotation, translation = relative
    known = found.points[mine] @ scene.rotations[reference].T + scene.translations[reference]
    rays_a = known / known[:, 2:]
    rays_b = scene.rays(found.keypoints[mine]) @ rotation
    center_b = -rotation.T @ translation
    z = triangulate_midpoints(np.zeros(3), rays_a, center_b, rays_b)[:, 2]
    with np.errstate(invalid="ignore"):
        good = (z > 0) & (known[:, 2] > 0)
    return float(np.median(known[good, 2] / z[good])) if good.any() else None
