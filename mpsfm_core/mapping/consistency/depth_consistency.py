"""Dense depth consistency check between posed images (paper section 3.4).

Each pixel of an image's refined depth map is projected into another image. If the pixel is clearly
in front of the surface in that image, both depth maps contradict each other, because that image
sees empty space where the pixel has a surface. A pixel behind the surface of the other image is
occluded. A contradiction of depth maps has one of two causes, wrong depth or a wrong pose.

* The depth of an image may be wrong. The errors of log depth in both images have normal
  distributions with standard deviations ``s`` and ``s'``. The likelihood of the contradiction is
  ``L = E_e[exp(-(e' / s')^2 / 2)]`` over the errors ``e`` of the pixel's log depth. An error ``e``
  shifts the pixel, and ``e'`` is the log-depth difference between the other surface and the shifted
  pixel, or 0 if the shifted pixel is occluded or outside the other image. At wide angles, an error
  of depth also shifts the pixel laterally in the other image. The likelihood ``L`` is the
  expectation over the depth error ``e`` instead of the maximum, because some error nearly always
  shifts the pixel past a depth edge.

* The pose of an image may be wrong. If the pose is wrong, the depth that the other image has along
  a pixel's ray is independent of the pixel's depth.

A pixel is a violation if its likelihood ``L`` is below that of a depth error of ``max_deviation``
standard deviations. The violation ratio (beta in the paper) is the share of violating pixels,
summed over both directions.

The depth check needs the standard deviation of depth at each pixel, because a good depth prior can
be wrong in a small region. Triangulated points that do not depend on the depth prior measure the
standard deviation of the prior
(:func:`~mpsfm_core.mapping.refinement.depth_noise.measure_local_depth_noise`). If nearby points
contradict the prior, the standard deviation grows and the pixel is no violation. If no nearby
points contradict the prior, the standard deviation of the whole scene applies. An image registered
to a look-alike place observes points only on look-alike structure, so structure that differs still
causes violations. Where no points are near, wrong depth remains a violation. Therefore the limit of
the violation ratio is raised by the share of outliers of the depth priors, which is measured at the
points of the whole scene
(:func:`~mpsfm_core.mapping.refinement.depth_noise.measure_outlier_ratio`). The violation ratio sums
over two depth maps, and about half of the outliers of each are in front of the surface.

The depth of an image is compared with the overlapping images of similar depth, not only with those
that share points. Images that share points with a misregistered image look alike, so their depth
may agree with the wrong pose.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera
from mpsfm_core.geometry import camera_center, pixel_centers, unproject
from mpsfm_core.mapping.consistency.visibility import Views
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.mapping.refinement.depth_noise import (
    MIN_GAP,
    find_well_constrained_keypoints,
    measure_local_depth_noise,
)
from mpsfm_core.mapping.scene.depth_map import DepthRefinement
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, subsample_camera
from mpsfm_core.support import jit
from mpsfm_core.support.disk_arrays import ArrayStore, current_store, is_on_disk

NUM_ERROR_STEPS = 4
"""Number of samples of the depth error on either side of 0, evenly spaced up to the option
``max_deviation``. [ours]"""
PIXEL_STRIDE = 2
"""Distance in pixels between the compared pixels of the subsampled depth maps. [ours]"""
MIN_SIGNIFICANCE = 3.0
"""Difference between the violation ratio of a quarter of the pixels and its limit, in standard
deviations of the ratio, beyond which the other pixels are skipped. [ours]"""
CACHED_BYTES = 1 << 29
"""Size limit of the cached subsampled depth maps in memory, bytes. [ours]"""
OVERLAP_GRID = 16
"""Columns and rows of the pixel grid that measures the overlap of two images. [ours]"""
NUM_COMPARED = 16
"""Number of most overlapping images whose depth is compared with that of an image. [ours]"""
NUM_SURROUNDING = 64
"""Number of images with the nearest camera centers. If an image was compared with each of them, its
depth is not compared with farther images either. [tuned: benchmarks.scale]"""
MIN_OVERLAP_RATIO = 0.05
"""Minimum share of grid pixels that project into another image for a comparison of both images.
[ours]"""


class DepthViolation(NamedTuple):
    """Largest violation ratio between the depth maps of an image and all other images."""

    ratio: float
    """Share of pixels with contradicting depth, summed over both images of the pair, in [0, 2]."""
    other_image: int
    """Index of the image that contradicts the checked image, or -1 if no image overlaps."""


class DepthConsistencyCheck:
    """Depth consistency check of the images of a scene, which caches subsampled depth maps.

    Args:
        scene: The scene.
        options: Thresholds of the depth consistency check.
        fill_holes: Fill holes of one or two pixels in sensor depth maps. An image with a slightly
            wrong pose would see other surfaces through unfilled holes.
    """

    def __init__(
        self, scene: Scene, options: ConsistencyOptions, *, fill_holes: bool = False
    ) -> None:
        self._scene = scene
        self._options = options
        self._fill_holes = fill_holes
        self._grids: dict[tuple[int, bool], tuple[_DepthMapState, _DepthGrid]] = {}
        self._num_bytes = 0
        self._angles_deg: Float64 | None = None  # of all points, while many images are compared

    def check_image(
        self,
        image: int,
        std_factor: float = 1.0,
        limit: float = math.nan,
        excluded: Collection[int] = (),
    ) -> DepthViolation:
        """Return the largest violation ratio of an image and its most overlapping images.

        Args:
            image: A registered image.
            std_factor: Ratio of the measured and the declared standard deviation of depth.
            limit: See :meth:`measure_violation_ratio`.
            excluded: Images with wrong depth, which are not compared with the image.
        """
        violations = [
            DepthViolation(self.measure_violation_ratio(image, other, std_factor, limit), other)
            for other in find_overlapping_images(self._scene, image)
            if other not in excluded
        ]
        return max(violations, default=DepthViolation(0.0, -1))

    def find_conflicting_images(
        self,
        images: Sequence[int] | Int64,
        limit: float,
        std_factor: float = 1.0,
        compared: Sequence[Int64] = (),
    ) -> list[tuple[int, float]]:
        """Find registered images to deregister such that no contradiction with ``images`` remains.

        Images with the most contradictions are deregistered first (greedy vertex cover).

        Args:
            images: Images whose depth is compared with all overlapping images.
            limit: Violation ratio above which two images contradict each other.
            std_factor: See :meth:`check_image`.
            compared: Sets of images that are not compared with each other again.

        Returns:
            Images to deregister, each with its largest violation ratio.
        """
        scene = self._scene
        views = _find_views_with_depth(scene)
        self._angles_deg = scene.track_angles_deg()
        measured: dict[tuple[int, int], float] = {}
        in_set = np.zeros((len(compared), scene.num_images), dtype=np.bool_)
        for members, is_member in zip(compared, in_set, strict=True):
            is_member[members] = True
        for image in map(int, _select_near_other_sets(scene, np.asarray(images), views, in_set)):
            for other in find_overlapping_images(scene, image, views):
                pair = min(image, other), max(image, other)
                if pair not in measured and not (in_set[:, image] & in_set[:, other]).any():
                    measured[pair] = self.measure_violation_ratio(
                        image, other, std_factor, limit, by_target_area=True
                    )
        self._angles_deg = None
        pairs = np.array(list(measured), dtype=np.int64).reshape(-1, 2)
        ratios = np.nan_to_num(np.array(list(measured.values())))
        removed = []
        while (ratios > limit).any():
            ends = pairs.ravel()
            num_conflicts = np.bincount(ends, np.repeat(ratios > limit, 2), scene.num_images)
            sums = np.bincount(ends, np.repeat(ratios, 2), scene.num_images)
            worst = int(np.lexsort((sums, num_conflicts))[-1])
            is_of_worst = (pairs == worst).any(axis=1)
            removed.append((worst, float(ratios[is_of_worst].max())))
            ratios[is_of_worst] = 0
        return removed

    def measure_violation_ratio(
        self,
        a: int,
        b: int,
        std_factor: float = 1.0,
        limit: float = math.nan,
        *,
        by_target_area: bool = False,
    ) -> float:
        """Measure the share of pixels at which one image sees empty space and the other a surface.

        The scaled depth priors are compared first, and the refined depth maps only if the priors
        contradict each other. Most depth maps need not be refined for the check.

        Args:
            a: A registered image.
            b: Another registered image.
            std_factor: See :meth:`check_image`.
            limit: Limit to which the violation ratio is compared. Only a quarter of the pixels is
                measured if their violation ratio is significantly above or below the limit. With a
                limit of NaN, all pixels are measured.
            by_target_area: Weight a violating pixel by its area in the other image, at most 1. The
                area weights reduce the influence of near surfaces that project to few pixels of the
                other image, so registered images are deregistered only by clearer evidence.
        """
        scene, options = self._scene, self._options
        rotation = scene.rotations[b] @ scene.rotations[a].T
        translation = scene.translations[b] - rotation @ scene.translations[a]
        criteria = ViolationCriteria(options.max_deviation, MIN_GAP, by_target_area)
        is_refined = any(scene.maps[image].refinement is not None for image in (a, b))

        def measure(*, refined: bool) -> float:
            grid_a = self._get_grid(a, std_factor, refined=refined)
            grid_b = self._get_grid(b, std_factor, refined=refined)
            return compute_violation_ratio(grid_a, grid_b, rotation, translation, criteria, limit)

        if is_refined and math.isnan(limit):
            return measure(refined=True)
        ratio = measure(refined=False)
        return measure(refined=True) if is_refined and ratio > limit else ratio

    def state_dict(self) -> StateDict:
        """Return the cached depth maps for a checkpoint, except depth maps that are outdated.

        The local depth noise of a cached depth map depends on the points from which the map was
        computed.
        """
        maps = self._scene.maps
        return {
            f"{image} {refined}": {
                "image": image,
                "refined": refined,
                "has_refinement": key.refinement is not None,
                "scale": key.scale,
                "camera": {**vars(key.camera)},
                "std_factor": key.std_factor,
                "grid": grid._asdict(),
            }
            for (image, refined), (key, grid) in self._grids.items()
            if key.refinement is None or key.refinement is maps[image].refinement
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the cached depth maps from a checkpoint, after the scene was restored."""
        for cached in state.values():
            image = cached["image"]
            refinement = self._scene.maps[image].refinement if cached["has_refinement"] else None
            camera = PinholeCamera(**cached["camera"])
            key = _DepthMapState(refinement, cached["scale"], camera, cached["std_factor"])
            self._add_grid((image, cached["refined"]), (key, _DepthGrid(**cached["grid"])))

    def _get_grid(self, image: int, std_factor: float, *, refined: bool) -> _DepthGrid:
        """Return the subsampled depth map of an image, from the cache if the map is unchanged."""
        depth_map = self._scene.maps[image]
        state = _DepthMapState(depth_map.refinement, depth_map.scale, depth_map.camera, std_factor)
        cached = self._grids.get((image, refined))
        if cached is None or cached[0] != state:
            depth = depth_map.depth if refined else depth_map.scaled_prior
            grid = self._make_grid(image, depth, std_factor)
            cached = state, grid.stored(current_store())
            self._add_grid((image, refined), cached)
        return cached[1]

    def _add_grid(self, key: tuple[int, bool], cached: tuple[_DepthMapState, _DepthGrid]) -> None:
        """Add a subsampled depth map to the cache, and remove the oldest if memory is full."""
        replaced = self._grids.pop(key, None)
        self._num_bytes += cached[1].nbytes - (replaced[1].nbytes if replaced else 0)
        self._grids[key] = cached
        while self._num_bytes > CACHED_BYTES and len(self._grids) > 2:
            self._num_bytes -= self._grids.pop(next(iter(self._grids)))[1].nbytes

    def _make_grid(self, image: int, depth: Float32, std_factor: float) -> _DepthGrid:
        depth_map = self._scene.maps[image]
        step = compute_subsampling_step(depth_map.valid.shape[1], self._options.map_width)
        # kernels compile again for read-only arrays and other memory layouts
        depth = np.ascontiguousarray(subsample(depth, step))
        valid = subsample(depth_map.valid, step).copy()
        std = subsample(depth_map.log_std, step) * np.float32(std_factor)
        if self._options.weigh_evidence:
            constrained = find_well_constrained_keypoints(self._scene, image, self._angles_deg)
            local = measure_local_depth_noise(self._scene, image, constrained, std_factor)
            std = subsample(depth_map.log_std, step) * subsample(local, step)
        # A projection error of one pixel changes the depth at edges and at grazing angles.
        kernel = np.ones((3, 3))
        nearest = cv2.erode(np.where(valid, depth, np.float32(np.inf)), kernel)
        if self._fill_holes:
            std = np.where(valid, std, cv2.dilate(np.where(valid, std, np.float32(0)), kernel))
            depth, valid = np.where(valid, depth, nearest), np.isfinite(nearest)
        intrinsics = np.array(subsample_camera(depth_map.camera, step).params)
        return _DepthGrid(depth, np.maximum(std, np.float32(1e-6)), valid, nearest, intrinsics)


def find_overlapping_images(scene: Scene, image: int, views: Views | None = None) -> list[int]:
    """Return the ``NUM_COMPARED`` images into which most pixels of a depth map project.

    A pixel counts by the ratio of the smaller and the larger of its depths in the two images.
    Without this ratio, images that are far away behind walls would come first in a large scene,
    because they see all pixels.

    Args:
        scene: The scene.
        image: Registered image with the depth map.
        views: Registered images with depth to choose from, by default all.
    """
    views = _find_views_with_depth(scene) if views is None else views
    depth_map = scene.maps[image]
    rows, columns = depth_map.prior.shape
    tiles = pixel_centers(OVERLAP_GRID, OVERLAP_GRID).reshape(4, OVERLAP_GRID // 4, 4, -1, 2)
    xy = tiles.swapaxes(1, 2).reshape(-1, 2) * [columns, rows] / OVERLAP_GRID
    at = xy[..., 1].astype(np.int64), xy[..., 0].astype(np.int64)
    depth = depth_map.scale * depth_map.prior.depth[at].astype(np.float64)
    points = unproject(depth_map.camera, xy, depth)
    is_valid = depth_map.valid[at]
    best = views.find_best(
        (points[is_valid] - scene.translations[image]) @ scene.rotations[image],
        depth[is_valid],
        num_best=NUM_COMPARED + 1,  # the image itself may be among them
        min_count=math.ceil(MIN_OVERLAP_RATIO * OVERLAP_GRID**2),
    )
    return [int(other) for other in best[best != image][:NUM_COMPARED]]


def _select_near_other_sets(scene: Scene, images: Int64, views: Views, in_set: Bool) -> Int64:
    """Select the images with a near image whose depth was not compared with theirs.

    The images that overlap most with an image are mostly among its ``NUM_SURROUNDING`` nearest.

    Args:
        scene: The scene.
        images: (m,) registered images.
        views: Registered images with depth.
        in_set: (s, n) bool membership of the images of the scene in sets of compared images.
            Without sets, all images are selected.
    """
    if not len(in_set) or len(views.images) <= NUM_SURROUNDING:
        return images
    centers = camera_center(scene.rotations[images], scene.translations[images])
    nearest = views.images[cKDTree(views.centers).query(centers, NUM_SURROUNDING)[1]]
    shares_set = np.zeros(nearest.shape, dtype=np.bool_)
    for is_member in in_set:
        shares_set |= is_member[images, None] & is_member[nearest]
    return images[~shares_set.all(axis=1)]


def _find_views_with_depth(scene: Scene) -> Views:
    """Return the registered images whose depth scale is known."""
    registered = scene.registered_images()
    is_active = [scene.maps[image].active for image in registered.tolist()]
    return Views.of_scene(scene, registered[np.array(is_active, dtype=np.bool_)])


class _DepthGrid(NamedTuple):
    """Subsampled depth map of one image."""

    depth: Float32
    """(h, w) depth in world units."""
    log_std: Float32
    """(h, w) standard deviation of the log depth."""
    valid: Bool
    """(h, w) bool mask of the pixels with known depth."""
    nearest: Float32
    """(h, w) smallest depth in the 3 x 3 neighborhood, in world units."""
    intrinsics: Float64
    """(4,) intrinsics fx, fy, cx, cy in pixels of the subsampled grid."""

    @property
    def nbytes(self) -> int:
        """Size of the arrays in memory in bytes."""
        return sum(array.nbytes for array in self if not is_on_disk(array))

    def stored(self, store: ArrayStore) -> _DepthGrid:
        """Return a copy whose arrays ``store`` has put in memory or in a mapped file."""
        depth, log_std, valid = store(self.depth), store(self.log_std), store(self.valid)
        return _DepthGrid(depth, log_std, valid, store(self.nearest), store(self.intrinsics))


class _DepthMapState(NamedTuple):
    """Inputs of a subsampled depth map, by which the cache detects that the map is outdated.

    The cache does not compare the points that measure the local depth noise, because the depth map
    is refined whenever these points change.
    """

    refinement: DepthRefinement | None
    scale: float
    camera: PinholeCamera
    std_factor: float


class ViolationCriteria(NamedTuple):
    """Criteria for a pixel to count as a violation of depth consistency."""

    max_deviation: float
    """Largest deviation that errors of depth explain, in standard deviations of log depth."""
    min_gap: float
    """Smallest distance between a violating pixel and the surface behind it, relative to the depth
    of that surface."""
    by_target_area: bool
    """Weight a violating pixel by its area in the other image, at most 1."""


@jit.kernel()
def compute_violation_ratio(
    grid_a: _DepthGrid,
    grid_b: _DepthGrid,
    rotation: Float64,
    translation: Float64,
    criteria: ViolationCriteria,
    limit: float,
) -> float:
    """Compute the share of pixels with contradicting depth, summed over both images.

    Args:
        grid_a: Subsampled depth map of the first image.
        grid_b: Subsampled depth map of the second image.
        rotation: (3, 3) ``b_from_a``.
        translation: (3,) ``b_from_a``.
        criteria: Criteria for a pixel to be a violation of depth consistency.
        limit: Limit with which the caller compares the violation ratio. Only a quarter of the
            pixels is measured if their violation ratio is significantly above or below the limit.
    """
    # Loops over scalars instead of array expressions, which take seconds to compile.
    inverse_rotation, inverse_translation = np.empty((3, 3)), np.zeros(3)
    for i in range(3):
        for j in range(3):
            inverse_rotation[i, j] = rotation[j, i]
            inverse_translation[i] -= rotation[j, i] * translation[j]
    violations_a, pixels_a, violations_b, pixels_b, ratio = 0.0, 0.0, 0.0, 0.0, 0.0
    for quarter in range(4):
        num_violations, num_pixels = _count_violations(
            grid_a, grid_b, rotation, translation, criteria, quarter
        )
        violations_a, pixels_a = violations_a + num_violations, pixels_a + num_pixels
        num_violations, num_pixels = _count_violations(
            grid_b, grid_a, inverse_rotation, inverse_translation, criteria, quarter
        )
        violations_b, pixels_b = violations_b + num_violations, pixels_b + num_pixels
        ratio = violations_a / pixels_a + violations_b / pixels_b
        std = math.sqrt(4 * limit / (pixels_a + pixels_b))
        if not quarter and abs(ratio - limit) > MIN_SIGNIFICANCE * std:
            break
    return ratio


@jit.helper()
def _count_violations(
    source: _DepthGrid,
    target: _DepthGrid,
    rotation: Float64,
    translation: Float64,
    criteria: ViolationCriteria,
    quarter: int,
) -> tuple[float, float]:
    """Count the violating and the compared pixels of one image on one of four pixel lattices."""
    rows, columns = target.depth.shape
    r, t, num_violations, num_pixels = rotation, translation, 0.0, 0.0
    limit = criteria.max_deviation
    zoom = target.intrinsics[0] / source.intrinsics[0]
    # sample the depth error 0 first, because most pixels are consistent without a depth error
    errors, weights = np.empty(2 * NUM_ERROR_STEPS + 1), np.empty(2 * NUM_ERROR_STEPS + 1)
    for step in range(len(errors)):
        error = limit * ((step + 1) // 2) / NUM_ERROR_STEPS * (1 - 2 * (step % 2))
        density = math.exp(-error * error / 2) * limit / NUM_ERROR_STEPS / math.sqrt(2 * math.pi)
        errors[step], weights[step] = error, density
    min_likelihood = math.exp(-limit * limit / 2)
    first_row = PIXEL_STRIDE // 2 + PIXEL_STRIDE * (quarter // 2)
    first_column = PIXEL_STRIDE // 2 + PIXEL_STRIDE * (quarter % 2)
    for row in range(first_row, source.depth.shape[0], 2 * PIXEL_STRIDE):
        y = (row + 0.5 - source.intrinsics[3]) / source.intrinsics[1]
        for column in range(first_column, source.depth.shape[1], 2 * PIXEL_STRIDE):
            num_pixels += 1.0
            if not source.valid[row, column]:
                continue
            x = (column + 0.5 - source.intrinsics[2]) / source.intrinsics[0]
            ray_x = r[0, 0] * x + r[0, 1] * y + r[0, 2]
            ray_y = r[1, 0] * x + r[1, 1] * y + r[1, 2]
            ray_z = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            source_depth, likelihood = np.float64(source.depth[row, column]), 0.0
            for step in range(len(errors)):
                error = errors[step] * source.log_std[row, column]
                depth = source_depth * math.exp(error) if step else source_depth
                z, target_error = depth * ray_z + t[2], 0.0
                if z > 1e-9:
                    inverse = 1.0 / z
                    u = (depth * ray_x + t[0]) * inverse * target.intrinsics[0]
                    v = (depth * ray_y + t[1]) * inverse * target.intrinsics[1]
                    u, v = u + target.intrinsics[2], v + target.intrinsics[3]
                    if 0 <= u < columns and 0 <= v < rows:
                        i, j = int(v), int(u)
                        surface = target.nearest[i, j]
                        if target.valid[i, j] and surface - z > criteria.min_gap * surface:
                            target_error = math.log(surface / z) / target.log_std[i, j]
                likelihood += weights[step] * math.exp(-target_error * target_error / 2)
                if likelihood >= min_likelihood:
                    break
            if likelihood < min_likelihood:
                area = (zoom * source_depth / (source_depth * ray_z + t[2])) ** 2
                num_violations += min(1.0, area) if criteria.by_target_area else 1.0
    return num_violations, max(num_pixels, 1.0)
