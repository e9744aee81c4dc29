"""Dense depth consistency check between views (paper section 3.4).

The refined map of one image is carried into another through a nearest-depth buffer. Where it
lands clearly in front of the surface that the other image sees, the two contradict each other:
something would have to float in space that was seen to be empty. Behind is an occlusion.

An image is held against all views that it overlaps with, not only those it shares points with:
those that led an image to a wrong place look alike there, others tell.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry import pixel_centers, unproject
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.optimize.thinning import thinned, thinned_camera, thinning_step
from mpsfm_core.scene.depth_map import DepthMap
from mpsfm_core.scene.scene import Scene

WARP_NOISE_PX = 1.0
"""Std of a pixel's position in the lift (reference: 1 px)."""
OVERLAP_GRID = 16
"""Columns and rows of the pixels by which overlap is judged (ours)."""
MIN_OVERLAP = 0.05
"""Share of those pixels that must fall into another view for a comparison (ours)."""


class Inconsistency(NamedTuple):
    """The view that contradicts an image most, and the share of contradicting pixels.

    ``share``: of the pixels of either map, summed over both directions, as beta in the paper,
    in [0, 2]. ``other``: -1 when no view overlaps.
    """

    share: float
    other: int


def check_image(
    scene: Scene, image: int, options: ConsistencyOptions, std_factor: float = 1.0
) -> Inconsistency:
    """How much an image contradicts the registered views that it overlaps with most.

    ``std_factor``: how many times its declaration the std of depth is.
    """
    found = [
        Inconsistency(contradiction(scene, image, other, options, std_factor), other)
        for other in overlapping_views(scene, image, options.num_views)
    ]
    return max(found, default=Inconsistency(0.0, -1))


def conflicting_images(
    scene: Scene, limit: float, options: ConsistencyOptions, std_factor: float = 1.0
) -> list[tuple[int, float]]:
    """Registered images to leave out so that no two contradict each other, and how much each did.

    ``limit``: share of contradicting pixels above which two do. The image with most conflicts goes
    first.
    """
    shares = np.zeros((scene.num_images, scene.num_images))
    for image in map(int, scene.registered_images()):
        for other in overlapping_views(scene, image, options.num_views):
            if not shares[image, other]:
                share = contradiction(scene, image, other, options, std_factor)
                shares[image, other] = shares[other, image] = share
    removed = []
    while (shares > limit).any():
        conflicts = (shares > limit).sum(axis=1)
        worst = int(np.lexsort((shares.sum(axis=1), conflicts))[-1])
        removed.append((worst, float(shares[worst].max())))
        shares[worst] = shares[:, worst] = 0
    return removed


def overlapping_views(scene: Scene, image: int, limit: int) -> list[int]:
    """Registered images, most overlapping first, into which a good part of a depth map falls."""
    others = scene.registered_images()
    others = others[(others != image) & np.array([scene.maps[i].active for i in others])]
    depth_map = scene.maps[image]
    rows, columns = depth_map.depth.shape
    xy = pixel_centers(OVERLAP_GRID, OVERLAP_GRID) * [columns, rows] / OVERLAP_GRID
    at = xy[..., 1].astype(np.int64), xy[..., 0].astype(np.int64)
    points = unproject(depth_map.camera, xy, depth_map.depth[at].astype(np.float64))
    world = (points[depth_map.valid[at]] - scene.translations[image]) @ scene.rotations[image]
    local = np.einsum("nij,pj->npi", scene.rotations[others], world)
    local += scene.translations[others][:, None]
    size = np.array([scene.problem.images[i].camera.size for i in others]).reshape(-1, 1, 2)
    focal, center = np.split(scene.intrinsics[others][:, None], 2, axis=2)
    front = local[..., 2] > 1e-9
    pixel = focal * local[..., :2] / np.where(front, local[..., 2], 1.0)[..., None] + center
    inside = front & ((pixel >= 0) & (pixel < size)).all(axis=2)
    share = inside.sum(axis=1) / OVERLAP_GRID**2
    order = np.argsort(-share, kind="stable")[:limit]
    return [int(others[k]) for k in order if share[k] >= MIN_OVERLAP]


def contradiction(
    scene: Scene, a: int, b: int, options: ConsistencyOptions, std_factor: float = 1.0
) -> float:
    """Share of pixels of two views at which one sees empty space and the other a surface."""
    grids = {i: _Grid.of(scene.maps[i], options.map_width, std_factor) for i in (a, b)}
    total = 0.0
    for source, target in ((a, b), (b, a)):
        rotation = scene.rotations[target] @ scene.rotations[source].T
        translation = scene.translations[target] - rotation @ scene.translations[source]
        one, two = grids[source], grids[target]
        depth, variance = warp_depth(*one, rotation, translation, two.params, two.depth.shape)
        seen = np.isfinite(depth) & two.valid
        # A pixel's error of place is an error of depth at edges and where sight grazes a surface.
        nearest = cv2.erode(np.where(two.valid, two.depth, np.float32(np.inf)), np.ones((3, 3)))
        gap = nearest[seen] - depth[seen]
        std = np.sqrt(variance[seen] + two.variance[seen])
        violated = (gap > options.max_deviation * std) & (gap > options.min_gap * two.depth[seen])
        total += float(violated.sum()) / two.depth.size
    return total


class _Grid(NamedTuple):
    """A depth map thinned out, with the (fx, fy, cx, cy) that belong to it."""

    depth: Float32
    variance: Float32
    valid: Bool
    params: Float64

    @staticmethod
    def of(depth_map: DepthMap, width: int, std_factor: float) -> _Grid:
        """Every n-th pixel, such that about ``width`` columns remain."""
        step = thinning_step(depth_map.valid.shape[1], width)
        depth = thinned(depth_map.depth, step)
        variance = (std_factor * thinned(depth_map.log_std, step) * depth) ** 2
        params = np.array(thinned_camera(depth_map.camera, step).params)
        return _Grid(depth, variance, thinned(depth_map.valid, step), params)


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def warp_depth(
    depth: Float32,
    variance: Float32,
    valid: Bool,
    params: Float64,
    rotation: Float64,
    translation: Float64,
    target_params: Float64,
    target_shape: tuple[int, int],
) -> tuple[Float64, Float64]:
    """Carry a depth map into another view, keeping the nearest surface per pixel.

    Args:
        depth, variance, valid: (h, w) maps of the source. params: its (fx, fy, cx, cy) on the
            grid. rotation, translation: ``target_from_source``. target_params, target_shape: the
            target's grid.

    Returns:
        Depth (inf where nothing lands) and variance of the carried depth, target shape, float64.
        The variance propagates that of the source's depth and of the pixel's position.
    """
    rows, columns = target_shape
    buffer = np.full((rows, columns), np.inf)
    spread = np.zeros((rows, columns))
    r, t = rotation, translation
    for row in range(depth.shape[0]):
        y = (row + 0.5 - params[3]) / params[1]
        for column in range(depth.shape[1]):
            if not valid[row, column]:
                continue
            d = float(depth[row, column])
            x = (column + 0.5 - params[2]) / params[0]
            slope = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            z = d * slope + t[2]
            if z <= 1e-9:
                continue
            u = (d * (r[0, 0] * x + r[0, 1] * y + r[0, 2]) + t[0]) / z
            v = (d * (r[1, 0] * x + r[1, 1] * y + r[1, 2]) + t[1]) / z
            u = u * target_params[0] + target_params[2]
            v = v * target_params[1] + target_params[3]
            if not (0 <= u < columns and 0 <= v < rows):
                continue
            i, j = int(v), int(u)
            if z < buffer[i, j]:
                buffer[i, j] = z
                across = (r[2, 0] / params[0]) ** 2 + (r[2, 1] / params[1]) ** 2
                noise = WARP_NOISE_PX**2 * d * d * across
                spread[i, j] = slope * slope * variance[row, column] + noise
    return buffer, spread
