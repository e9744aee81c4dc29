"""Images that see most of the 3D points of a depth map, at a similar distance."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float64, Int64
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.frustum import frustum_planes
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.support import jit

POINT_GROUP = 16
"""Number of points with a common bounding sphere. [ours]"""
NUM_NEAREST = 64
"""Number of nearest images that are measured first, so that most others can be skipped. [ours]"""


class Views(NamedTuple):
    """Registered images in which points may be visible."""

    images: Int64
    """(n,) indices of the images."""
    centers: Float64
    """(n, 3) camera centers in the world frame."""
    rotations: Float64
    """(n, 3, 3) rotations ``cam_from_world``."""
    translations: Float64
    """(n, 3) ``cam_from_world``."""
    intrinsics: Float64
    """(n, 4) intrinsics fx, fy, cx, cy in pixels."""
    sizes: Float64
    """(n, 2) width and height in pixels."""
    frusta: Float64
    """(n, 5, 4) planes from :func:`~mpsfm_core.geometry.frustum.frustum_planes`."""

    @classmethod
    def of_scene(cls, scene: Scene, images: Int64) -> Views:
        """Return the views of registered images of a scene."""
        return cls.of_cameras(
            images,
            scene.rotations[images],
            scene.translations[images],
            scene.intrinsics[images],
            scene.image_sizes[images],
        )

    @classmethod
    def of_cameras(
        cls,
        images: Int64,
        rotations: Float64,
        translations: Float64,
        intrinsics: Float64,
        sizes: Float64,
    ) -> Views:
        """Return the views of cameras, with arguments as the attributes of the same names."""
        centers = camera_center(rotations, translations)
        frusta = frustum_planes(rotations, translations, intrinsics, sizes)
        return cls(images, centers, rotations, translations, intrinsics, sizes, frusta)

    def find_best(
        self, points: Float64, depths: Float64, *, num_best: int, min_count: int = 1
    ) -> Int64:
        """Return the images that see most points, each weighted by its ratio of depths.

        Args:
            points: See :func:`measure_visibility`.
            depths: See :func:`measure_visibility`.
            num_best: Maximum number of images.
            min_count: Minimum number of points that an image sees.

        Returns:
            Indices of the images, those with the largest sums of depth ratios first.
        """
        counts, similarities = measure_visibility(points, depths, self, num_best, min_count)
        rows = np.flatnonzero(counts >= min_count)
        best: Int64 = rows[np.argsort(-similarities[rows], kind="stable")][:num_best]
        return self.images[best]


def measure_visibility(
    points: Float64, depths: Float64, views: Views, num_best: int, min_count: int
) -> tuple[Int64, Float64]:
    """Count the 3D points that project into each image, and compare their depths.

    Args:
        points: (p, 3) points in the world frame. Neighbors should be close to each other, because
            groups of ``POINT_GROUP`` points are skipped if an image does not see their bounding
            sphere, and all points if an image does not see that of all points.
        depths: (p,) depth of each point in another image, in world units.
        views: The n images.
        num_best: Number of images with the largest sums of depth ratios that are needed.
        min_count: Minimum number of visible points of the needed images.

    Returns:
        Number (n,) of visible points, and sum (n,) of the ratios in [0, 1] of the smaller and the
        larger depth of each visible point. Both are 0 for images that are not needed.
    """
    order = np.arange(len(views.images))
    if num_best < len(order) and len(order) > NUM_NEAREST and len(points):
        distances = ((views.centers - points.mean(axis=0)) ** 2).sum(axis=1)
        order = np.argpartition(distances, NUM_NEAREST)
    return _measure_visibility(points, depths, order, *views[2:], num_best, min_count)


@jit.kernel()
def _measure_visibility(
    points: Float64,
    depths: Float64,
    order: Int64,
    rotations: Float64,
    translations: Float64,
    intrinsics: Float64,
    sizes: Float64,
    frusta: Float64,
    num_best: int,
    min_count: int,
) -> tuple[Int64, Float64]:
    """Measure the images in the given order, as :func:`measure_visibility`.

    An image is skipped as soon as its upper bound is below the smallest of the best sums so far.
    """
    num_groups = (len(points) + POINT_GROUP - 1) // POINT_GROUP
    bounds, balls = np.zeros(num_groups), np.zeros((num_groups + 1, 6))
    for group in range(num_groups):
        members = slice(group * POINT_GROUP, (group + 1) * POINT_GROUP)
        _bound_points(points[members], depths[members], balls[group])
    _bound_points(points, depths, balls[num_groups])
    counts, sums = np.zeros(len(rotations), np.int64), np.zeros(len(rotations))
    best = np.zeros(num_best)  # ascending
    for image in order:
        needed = best[0] * (1 - 1e-9)
        bound = _bound_sum(balls, frusta, image, len(points), needed, bounds)
        if bound < needed or bound == 0:
            continue
        count, total = 0, 0.0
        r, t = rotations[image], translations[image]
        fx, fy, cx, cy = intrinsics[image]
        width, height = sizes[image]
        for group in range(num_groups):
            if bound + total < needed:
                break
            bound -= bounds[group]
            if bounds[group] == 0:
                continue
            for k in range(group * POINT_GROUP, min((group + 1) * POINT_GROUP, len(points))):
                x, y, z = points[k, 0], points[k, 1], points[k, 2]
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
                if depth <= 1e-9:
                    continue
                # u and v are pixels times depth, because divisions are slow
                u = fx * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) + cx * depth
                v = fy * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) + cy * depth
                if 0 <= u < width * depth and 0 <= v < height * depth:
                    count += 1
                    total += min(depth, depths[k]) / max(depth, depths[k])
        if total >= needed:
            counts[image], sums[image] = count, total
        if count >= min_count:
            _insert(best, total)
    return counts, sums


@jit.helper()
def _bound_sum(
    balls: Float64, frusta: Float64, image: int, num_points: int, needed: float, bounds: Float64
) -> float:
    """Return an upper bound of the sum of depth ratios of all points that project into an image.

    A bound below ``needed`` is not improved further.

    Args:
        balls: (g + 1, 6) bounds of each group of points and of all points, from
            :func:`_bound_points`.
        frusta: (n, 5, 4) planes of the frustum of each image.
        image: Row of the image in ``frusta``.
        num_points: Number of points.
        needed: Sum of depth ratios that is needed.
        bounds: (g,) upper bound of the sum of each group, which is overwritten.
    """
    bound: float = num_points * _bound_ratio(balls, len(bounds), frusta, image)
    if bound < needed or _is_outside(balls, len(bounds), frusta, image):
        return 0.0
    bound = float(num_points)
    for group in range(len(bounds)):
        size = min(POINT_GROUP, num_points - group * POINT_GROUP)
        bounds[group] = size * _bound_ratio(balls, group, frusta, image)
        bound -= size - bounds[group]
        if bound < needed:
            return bound
    for group in range(len(bounds)):
        if _is_outside(balls, group, frusta, image):
            bound -= bounds[group]
            bounds[group] = 0.0
            if bound < needed:
                return bound
    return bound


@jit.helper()
def _insert(best: Float64, value: float) -> None:
    """Replace the smallest of ascending values by a larger value."""
    rank = 0
    while rank + 1 < len(best) and best[rank + 1] < value:
        best[rank] = best[rank + 1]
        rank += 1
    best[rank] = max(best[rank], value)


@jit.helper()
def _bound_points(points: Float64, depths: Float64, ball: Float64) -> None:
    """Compute the bounding sphere and the range of depths of points.

    Args:
        points: (p, 3) points.
        depths: (p,) depth of each point.
        ball: (6,) zeros, which are overwritten by center and radius of the sphere, and by the
            smallest and the largest depth.
    """
    for k in range(len(points)):
        for a in range(3):
            ball[a] += points[k, a] / len(points)
    for k in range(len(points)):
        x, y, z = points[k]
        x, y, z = x - ball[0], y - ball[1], z - ball[2]
        radius = math.sqrt(x * x + y * y + z * z) * (1.0 + 1e-9)
        ball[3] = max(ball[3], radius)
        ball[4] = min(ball[4], depths[k]) if k else depths[k]
        ball[5] = max(ball[5], depths[k])


@jit.helper()
def _is_outside(balls: Float64, row: int, frusta: Float64, image: int) -> bool:
    """Return True if a sphere is behind one of the planes of the frustum of an image."""
    x, y, z, radius = balls[row, 0], balls[row, 1], balls[row, 2], balls[row, 3]
    for a in range(5):
        height = frusta[image, a, 0] * x + frusta[image, a, 1] * y + frusta[image, a, 2] * z
        if height + frusta[image, a, 3] < -radius:
            return True
    return False


@jit.helper()
def _bound_ratio(balls: Float64, row: int, frusta: Float64, image: int) -> float:
    """Return an upper bound of the depth ratios of the points in a sphere.

    The first plane of the frustum measures the depth in the image. Arguments are arrays with rows,
    because a view of a row takes longer than the computation.
    """
    depth = frusta[image, 0, 0] * balls[row, 0] + frusta[image, 0, 1] * balls[row, 1]
    depth += frusta[image, 0, 2] * balls[row, 2] + frusta[image, 0, 3]
    nearest, farthest = depth - balls[row, 3], depth + balls[row, 3]
    smallest, largest = balls[row, 4], balls[row, 5]
    bound = 1.0
    if nearest > largest:
        bound = largest / nearest
    elif farthest < smallest:
        bound = max(farthest, 0.0) / smallest
    return bound
