"""How good the depth priors are in this scene, measured from how well views agree.

A prior declares a variance per pixel. Whether that is too large or too small, and how much the
errors of neighbouring pixels have in common, shows when matched keypoints of two posed views are
compared: the depth of one, carried into the other, against the other's own. Bundle adjustment
takes observations as independent; a hundred observations with one common error must not count a
hundred times.

How good a prior is at one place may be another matter (:func:`measure_local_depth_noise`): points that rays hold
without its help tell.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, Float32, Float64, Int64
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.geometry.statistics import MAD_TO_STD, group_medians
from mpsfm_core.mapping.scene.scene import Scene

CELLS = 4
"""Residuals are compared in a grid of this many cells per side (ours)."""
MIN_RESIDUALS = 25
"""Fewer say too little: the declaration stands (ours)."""
MIN_INDEPENDENT = 0.05
"""Share of the variance of depth that is independent, at least (ours)."""
POSE_UNKNOWNS = 6
"""Of a pose beside the others."""
MULTIPLIER_RANGE = (0.1, 10.0)
"""Bounds of the multiplier (ours): a declaration is not off by more without being broken."""
WITNESS_ANGLE_DEG = 2.0
"""Angle between rays from which on a point does not hang on depth: that from which on points anchor
the integration. Two views are enough. A pose that is wrong moves their points all over the image,
and has no support from matches then; what is off around one place is the prior. (Points of three
views only leave 328 instead of 358 of 392 images in halls with few matches whose priors are wrong
by half in a tenth; two rooms come out the same, ``benchmarks/results/everyday.md``.)"""
NUM_WITNESSES = 7
"""Witnesses around a place, of whose errors the median counts: four of them have to deny a prior,
so that no single wrong point does (ours)."""
WITNESS_REACH = 1 / 8
"""Share of a map's width that errors have in common (as
:class:`~mpsfm_core.testing.synthetic.degraded_depth.DepthErrors`): farther find_well_constrained_keypoints say
nothing."""
PLACES = 16
"""Columns and rows of the places at which noise is measured (ours; half the reach apart)."""


class DepthNoise(NamedTuple):
    """``multiplier`` of the declared std; ``correlation`` of errors in the same cell, [0, 1]; and
    ``design_effect``: by how much the variance of a mean of the observations exceeds that of
    independent ones (Kish, Survey Sampling, 1965)."""

    multiplier: float = 1.0
    correlation: float = 1.0
    design_effect: float = 1.0

    @property
    def std_factor(self) -> float:
        """Factor of the declared std that makes observations count as if independent."""
        return self.multiplier * float(np.sqrt(self.design_effect))

    @property
    def loss_factor(self) -> float:
        """Factor of a loss scale for residuals in terms of that std: the scale then counts in stds
        of what is independent in an error, as an outlier stands out from its neighbours."""
        if self.design_effect == 1.0:
            return 1.0  # independent, or nothing to tell it by
        independent = max(1.0 - self.correlation, MIN_INDEPENDENT)
        return float(np.sqrt(independent / self.design_effect))

    def independent_pixels(self, pixels: int) -> float:
        """How many independent measurements a map of so many pixels is worth."""
        return pixels / (1.0 + (pixels / CELLS**2 - 1.0) * self.correlation)


def measure_depth_noise(scene: Scene) -> DepthNoise:
    """Compare the scaled priors of all pairs of registered views at their common points.

    What all residuals of a pair have in common is left out: it may be due to the scales of the two
    images, which are unknowns of bundle adjustment and no part of what a prior declares.

    Scales and poses are fitted to what is compared. The variance is the sum of squares over as many
    independent residuals as there are beyond these unknowns, where the declaration counts as one
    more of them (a unit information prior). Rays hold most of a pose, so that depth alone is fitted
    by fewer; but a network errs alike in both views of a pair, which no difference shows, and
    counted in full unknowns make up for it where few pairs hold an image (ours, on
    rendered_kitchen: ``benchmarks/results/depth_noise.md``).
    """
    residuals, groups = _cross_view_residuals(scene)
    if len(residuals) < MIN_RESIDUALS:
        return DepthNoise()
    pairs, pair = np.unique(groups // CELLS**2, return_inverse=True)
    residuals = residuals - group_medians(residuals, pair, len(pairs))[pair]
    spread = max(MAD_TO_STD * float(np.median(np.abs(residuals))), 1e-12)
    correlation, effect = _clustering(np.clip(residuals / spread, -3, 3), groups)
    images = np.unique([pairs // scene.num_images, pairs % scene.num_images])
    independent = len(residuals) / effect
    unknown = len(pairs) + POSE_UNKNOWNS * (len(images) - 1)
    variance = (1.0 + independent * spread**2) / (1.0 + max(independent - unknown, 0.0))
    multiplier = float(np.clip(np.sqrt(variance), *MULTIPLIER_RANGE))
    return DepthNoise(multiplier, correlation, effect)


def find_well_constrained_keypoints(scene: Scene, image: int) -> Bool:
    """(k,) bool, keypoints of an image whose points rays hold without depth."""
    points = scene.tracks.point_of[scene.graph.keypoints_of(image)]
    seen = points >= 0
    holds = np.zeros(len(points), dtype=np.bool_)
    holds[seen] = scene.angles_deg_of(points[seen])[0] >= WITNESS_ANGLE_DEG
    return holds


def measure_local_depth_noise(scene: Scene, image: int, witness: Bool, least: float) -> Float32:
    """How many times its declaration the std of a prior is from place to place: (h, w) float32.

    Witnesses (``witness``: (k,) bool, of the image's keypoints) that are near have an error in
    common, of which the median of the nearest is a robust estimate: one observation of the std
    there. ``least``, the std on the whole, is as good as another (a unit information prior), and
    the factor is nowhere below it. Witnesses that lack within reach count as if off by ``least``.
    """
    graph, tracks, depth_map = scene.graph, scene.tracks, scene.maps[image]
    rows, columns = depth_map.valid.shape
    point = tracks.point_of[graph.keypoints_of(image)]
    seen = np.flatnonzero(depth_map.keypoint_valid & witness)
    z = tracks.xyz[point[seen]] @ scene.rotations[image, 2] + scene.translations[image, 2]
    prior = depth_map.scale * depth_map.prior_at_keypoints(seen)
    use = (z > 0) & (prior > 0)
    if use.sum() <= NUM_WITNESSES // 2:
        return np.full((rows, columns), least, dtype=np.float32)
    log_std = np.maximum(depth_map.keypoint_log_std[seen[use]], 1e-6)
    errors = np.abs(np.log(z[use] / prior[use])) / log_std
    places = pixel_centers(PLACES, PLACES).reshape(-1, 2) * [columns, rows] / PLACES
    _, nearest = cKDTree(depth_map.keypoints[seen[use]]).query(
        places, NUM_WITNESSES, distance_upper_bound=WITNESS_REACH * columns
    )
    error = np.median(np.append(errors, least)[nearest], axis=1)
    spread = np.maximum(np.sqrt((least**2 + error**2) / 2), least)
    grid = spread.reshape(PLACES, PLACES).astype(np.float32)
    noise: Float32 = cv2.resize(grid, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return noise


def _cross_view_residuals(scene: Scene) -> tuple[Float64, Int64]:
    """Whitened log differences (m,), one of each match, and the group of each: a cell of the first
    view beside the other."""
    graph, tracks = scene.graph, scene.tracks
    point = tracks.point_of[graph.source]
    same = (point >= 0) & (point == tracks.point_of[graph.target]) & (graph.source < graph.target)
    source, target = graph.source[same], graph.target[same]
    active = np.array([depth_map.active for depth_map in scene.maps])[graph.image_of]
    prior = scene.keypoint_prior * scene.scales()[graph.image_of]
    known = scene.keypoint_valid & active & (prior > 0)
    both = known[source] & known[target]
    source, target = source[both], target[both]
    a, b = graph.image_of[source], graph.image_of[target]
    camera_points = scene.rays(source) * prior[source, None]
    world = np.einsum("nji,nj->ni", scene.rotations[a], camera_points - scene.translations[a])
    carried = np.einsum("nj,nj->n", scene.rotations[b, 2], world) + scene.translations[b, 2]
    centers = scene.centers()
    origin = np.einsum("nj,nj->n", scene.rotations[b, 2], centers[a]) + scene.translations[b, 2]
    front = carried > 1e-9
    source, target, carried, origin = source[front], target[front], carried[front], origin[front]
    gain = (carried - origin) / carried
    variance = (gain * scene.keypoint_log_std[source]) ** 2 + scene.keypoint_log_std[target] ** 2
    residuals = np.log(carried / prior[target]) / np.sqrt(np.maximum(variance, 1e-12))
    size = np.array([image.camera.size for image in scene.problem.images])
    place = np.floor(CELLS * scene.keypoints[source] / size[graph.image_of[source]])
    row, column = np.clip(place, 0, CELLS - 1).astype(np.int64).T
    pair = graph.image_of[source] * scene.num_images + graph.image_of[target]
    return residuals, (pair * CELLS + row) * CELLS + column


def _clustering(values: Float64, groups: Int64) -> tuple[float, float]:
    """Intraclass correlation r by analysis of variance, and ``1 + (mean group size - 1) * r``."""
    _, group, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    count, total = len(sizes), len(values)
    if count < 2 or total <= count:
        return 1.0, 1.0
    means = np.bincount(group, values) / sizes
    between = float((sizes * means**2).sum()) / count
    within = float(((values - means[group]) ** 2).sum()) / (total - count)
    typical = (total - float((sizes**2).sum()) / total) / (count - 1)
    raw = (between - within) / max(between + (typical - 1) * within, 1e-12)
    correlation = float(np.clip(raw, 0, 1))
    weighted_size = float((sizes**2).sum()) / total
    return correlation, 1.0 + max(weighted_size - 1, 0.0) * correlation
