"""Measurement of the noise of depth priors from the agreement of image pairs.

A depth prior declares a variance for each pixel. The depth prior at a matched keypoint is projected
into the other image of the pair, and compared with the depth prior of the other image. The
differences between projected and prior depth show whether the declared variance is too large or too
small, and how much errors of neighboring pixels correlate.

Bundle adjustment treats observations as independent, so correlated observations need a larger
variance.

Depth priors are also wrong in whole regions by many standard deviations. The share of such outliers
is measured at points that rays from three images constrain well.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, Float32, Float64, Int64
from mpsfm_core.geometry import camera_center, pixel_centers
from mpsfm_core.geometry.statistics import MAD_TO_STD, group_medians
from mpsfm_core.mapping.scene.graph import BLOCK_MATCHES
from mpsfm_core.mapping.scene.scene import Scene

CELLS = 4
"""Rows and columns of a grid of image cells; errors of depth in the same cell are treated as
correlated. [ours]"""
MIN_RESIDUALS = 25
"""Minimum number of depth residuals for a measurement of the noise. With fewer than
``MIN_RESIDUALS`` depth residuals, the declared variance of the depth prior applies. [ours]"""
MIN_INDEPENDENT = 0.05
"""Minimum share of the depth variance that is noise independent between pixels. [ours]"""
POSE_UNKNOWNS = 6
"""Degrees of freedom of the pose of an additional image."""
MULTIPLIER_RANGE = (0.1, 10.0)
"""Range of the factor between the measured and the declared standard deviation of depth. [ours]"""
MIN_GAP = 0.05
"""Smallest relative difference at which a depth prior contradicts a 3D point or the depth map of
another image. [tuned: benchmarks.symmetry]"""
MIN_OUTLIER_TRACK_LENGTH = 3
"""Minimum track length of the 3D points that measure the share of outliers. Points of two images
may be wrong themselves, if one of the images is misregistered. [COLMAP ignore_two_view_tracks]"""
MIN_CONSTRAINED_ANGLE_DEG = 2.0
"""Minimum triangulation angle of a point that rays constrain well without depth. Two observations
of a point suffice, because a wrong pose makes all points of an image contradict the depth prior,
but a wrong prior only some points. [ours]"""
NUM_NEIGHBORS = 7
"""Number of nearest well-constrained points whose median error measures the depth prior. The median
error changes if at least four of the seven points contradict the depth prior. [ours]"""
MAX_NEIGHBOR_DISTANCE = 1 / 8
"""Maximum distance between a pixel and a well-constrained point, relative to the width of the depth
map. Errors of depth priors do not correlate at larger distances. [ours]"""
GRID_SIZE = 16
"""Columns and rows of the grid of image positions at which the local depth noise is measured.
[ours]"""


class DepthNoise(NamedTuple):
    """Measured noise of the depth priors, relative to the declared variance."""

    multiplier: float = 1.0
    """Factor between the measured and the declared standard deviation of depth."""
    correlation: float = 1.0
    """Correlation of the depth errors in one image cell, in [0, 1]."""
    design_effect: float = 1.0
    """Ratio of the variances of the mean of correlated and of independent observations (Kish,
    Survey Sampling, 1965)."""
    outlier_ratio: float = 0.0
    """Share of well-constrained points whose depth contradicts the depth prior, in [0, 1]."""

    @property
    def std_factor(self) -> float:
        """Factor on the declared std of depth that allows to treat observations as independent."""
        return self.multiplier * float(np.sqrt(self.design_effect))

    @property
    def loss_factor(self) -> float:
        """Factor on the scale of the depth loss, for residuals in units of the corrected std.

        The scale of the depth loss refers to the part of the depth error that is independent
        between neighboring pixels, because an outlier differs from its neighbors.
        """
        if self.design_effect == 1.0:
            return 1.0  # depth errors are independent, or were not measured
        independent = max(1.0 - self.correlation, MIN_INDEPENDENT)
        return float(np.sqrt(independent / self.design_effect))

    def independent_pixels(self, num_pixels: int) -> float:
        """Return the effective number of independent depths in a depth map of ``num_pixels``."""
        return num_pixels / (1.0 + (num_pixels / CELLS**2 - 1.0) * self.correlation)


def measure_depth_noise(scene: Scene) -> DepthNoise:
    """Measure the noise of the scaled depth priors from all pairs of registered images.

    The median residual of each image pair is subtracted, because bundle adjustment estimates the
    depth scales. The variance of the noise is the sum of squared residuals divided by the degrees
    of freedom, which are the effective number of residuals minus the fitted scales and poses. The
    declared variance counts as one additional residual (a unit information prior).

    Returns:
        Measured depth noise, or the declared noise if too few residuals exist.
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


def measure_outlier_ratio(scene: Scene, std_factor: float, max_deviation: float) -> float:
    """Measure the share of outliers of the depth priors at well-constrained points.

    Keypoints at depth edges are left out, because they may observe either surface.

    Args:
        scene: The scene.
        std_factor: Ratio of the measured and the declared standard deviation of depth.
        max_deviation: Largest deviation of log depth that is no contradiction, in standard
            deviations.

    Returns:
        The share, or 0 for fewer than ``MIN_RESIDUALS`` observations.
    """
    tracks, graph = scene.tracks, scene.graph
    observations = tracks.observations()
    points = tracks.point_of[observations]
    is_long = np.bincount(points, minlength=len(tracks.xyz)) >= MIN_OUTLIER_TRACK_LENGTH
    is_used = is_long & (scene.track_angles_deg() >= MIN_CONSTRAINED_ANGLE_DEG)
    keypoints = observations[is_used[points]]
    keypoints = keypoints[_lie_on_surfaces(scene)[keypoints]]
    _, z = scene.project(keypoints, tracks.xyz[tracks.point_of[keypoints]])
    prior = scene.keypoint_prior[keypoints] * scene.scales()[graph.image_of[keypoints]]
    usable = (prior > 0) & (z > 0)
    if np.count_nonzero(usable) < MIN_RESIDUALS:
        return 0.0
    errors = np.abs(np.log(z[usable] / prior[usable]))
    max_errors = max_deviation * std_factor * scene.keypoint_log_std[keypoints[usable]]
    return float(np.mean(errors > np.maximum(max_errors, MIN_GAP)))


def _lie_on_surfaces(scene: Scene) -> Bool:
    """Return a mask (k,) of the keypoints with depth of known scale that are at no depth edge."""
    known: Bool = scene.keypoint_valid.copy()
    for image, depth_map in enumerate(scene.maps):
        of_image = scene.graph.keypoints_of(image)
        known[of_image] &= depth_map.active and ~depth_map.keypoint_at_edge
    return known


def find_well_constrained_keypoints(
    scene: Scene, image: int, angles_deg: Float64 | None = None
) -> Bool:
    """Return a mask (k,) of the keypoints whose 3D points rays constrain well without depth.

    Args:
        scene: The scene.
        image: A registered image.
        angles_deg: Triangulation angles (p,) of all points in degrees, or None to compute those of
            the image.
    """
    points = scene.tracks.point_of[scene.graph.keypoints_of(image)]
    is_observed = points >= 0
    is_constrained = np.zeros(len(points), dtype=np.bool_)
    observed = points[is_observed]
    angles = scene.angles_deg_of(observed)[0] if angles_deg is None else angles_deg[observed]
    is_constrained[is_observed] = angles >= MIN_CONSTRAINED_ANGLE_DEG
    return is_constrained


def measure_local_depth_noise(
    scene: Scene, image: int, is_constrained: Bool, min_factor: float
) -> Float32:
    """Measure the ratio of measured to declared standard deviation of a depth prior, per pixel.

    The depth error at a grid node is the median error of the nearest well-constrained points. The
    median error counts as one observation, and ``min_factor`` as a second observation (a unit
    information prior). If fewer than ``NUM_NEIGHBORS`` points are near the node, each missing point
    counts as a depth error of ``min_factor``.

    Args:
        scene: The scene.
        image: A registered image.
        is_constrained: (k,) bool mask of the keypoints from
            :func:`find_well_constrained_keypoints`.
        min_factor: Measured noise factor of the whole scene, which is the lower bound of the local
            factor.

    Returns:
        (h, w) float32 factor on the declared standard deviation of depth.
    """
    graph, tracks, depth_map = scene.graph, scene.tracks, scene.maps[image]
    rows, columns = depth_map.valid.shape
    point = tracks.point_of[graph.keypoints_of(image)]
    keypoints = np.flatnonzero(depth_map.keypoint_valid & is_constrained)
    z = tracks.xyz[point[keypoints]] @ scene.rotations[image, 2] + scene.translations[image, 2]
    prior = depth_map.scale * depth_map.prior_at_keypoints(keypoints)
    usable = (z > 0) & (prior > 0)
    if usable.sum() <= NUM_NEIGHBORS // 2:
        return np.full((rows, columns), min_factor, dtype=np.float32)
    log_std = np.maximum(depth_map.keypoint_log_std[keypoints[usable]], 1e-6)
    errors = np.abs(np.log(z[usable] / prior[usable])) / log_std
    nodes = pixel_centers(GRID_SIZE, GRID_SIZE).reshape(-1, 2) * [columns, rows] / GRID_SIZE
    _, nearest = cKDTree(depth_map.keypoints[keypoints[usable]]).query(
        nodes, NUM_NEIGHBORS, distance_upper_bound=MAX_NEIGHBOR_DISTANCE * columns
    )
    error = np.median(np.append(errors, min_factor)[nearest], axis=1)
    factors = np.maximum(np.sqrt((min_factor**2 + error**2) / 2), min_factor)
    grid = factors.reshape(GRID_SIZE, GRID_SIZE).astype(np.float32)
    noise: Float32 = cv2.resize(grid, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return noise


def _cross_view_residuals(scene: Scene) -> tuple[Float64, Int64]:
    """Return whitened log-depth differences (m,) of matches, and the group (m,) of each match.

    A group contains the matches between one grid cell of the first image of a pair and the second
    image.
    """
    scales = scene.scales()
    is_active = np.array([depth_map.active for depth_map in scene.maps])
    num_edges = len(scene.graph.source)
    blocks = [
        _measure_residuals(scene, edges, scales, is_active)
        for edges in np.array_split(np.arange(num_edges), 1 + num_edges // BLOCK_MATCHES)
    ]
    residuals, groups = zip(*blocks, strict=True)
    return np.concatenate(residuals), np.concatenate(groups)


def _measure_residuals(
    scene: Scene, edges: Int64, scales: Float64, is_active: Bool
) -> tuple[Float64, Int64]:
    """Return the residuals and groups of :func:`_cross_view_residuals` of some matches.

    Args:
        scene: The scene.
        edges: (e,) edges of the correspondence graph.
        scales: (n,) scales of the depth priors.
        is_active: (n,) bool mask of the images with depth of known scale.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = edges[graph.source[edges] < graph.target[edges]]
    source, target = graph.source[edges], graph.target[edges]
    point = tracks.point_of[source]
    is_used = (point >= 0) & (point == tracks.point_of[target])
    source, target = source[is_used], target[is_used]
    is_used = np.ones(len(source), dtype=np.bool_)
    for keypoints in (source, target):
        is_known = scene.keypoint_valid[keypoints] & is_active[graph.image_of[keypoints]]
        is_used &= is_known & (scene.keypoint_prior[keypoints] > 0)
    source, target = source[is_used], target[is_used]
    a, b = graph.image_of[source], graph.image_of[target]
    prior_a, prior_b = (
        scene.keypoint_prior[source] * scales[a],
        scene.keypoint_prior[target] * scales[b],
    )
    camera_points = scene.rays(source) * prior_a[:, None]
    world = np.einsum("nji,nj->ni", scene.rotations[a], camera_points - scene.translations[a])
    axes, offsets = scene.rotations[b, 2], scene.translations[b, 2]
    projected = np.einsum("nj,nj->n", axes, world) + offsets
    centers = camera_center(scene.rotations, scene.translations)[a]
    origin = np.einsum("nj,nj->n", axes, centers) + offsets
    gain = (projected - origin) / np.maximum(projected, 1e-9)
    variance = (gain * scene.keypoint_log_std[source]) ** 2 + scene.keypoint_log_std[target] ** 2
    residuals = np.log(np.maximum(projected, 1e-9) / prior_b) / np.sqrt(np.maximum(variance, 1e-12))
    cell = np.floor(CELLS * scene.keypoints[source] / scene.image_sizes[a])
    row, column = np.clip(cell, 0, CELLS - 1).astype(np.int64).T
    pair = a * scene.num_images + b
    front = projected > 1e-9
    return residuals[front], ((pair * CELLS + row) * CELLS + column)[front]


def _clustering(values: Float64, groups: Int64) -> tuple[float, float]:
    """Return the intraclass correlation r of residual groups, and their design effect.

    The intraclass correlation is estimated by one-way analysis of variance, and the design effect
    is ``1 + (mean group size - 1) * r``.
    """
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
