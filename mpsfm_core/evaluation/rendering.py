"""Software rendering of point clouds and triangle meshes into pinhole cameras."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera, Pose, UInt8
from mpsfm_core.geometry import transform
from mpsfm_core.geometry.rasterization import covered_range, rasterize
from mpsfm_core.support.jit import kernel

_NUM_NEIGHBORS = 4
"""Number of nearest neighbors of a point whose distance gives the radius of its splat."""
_MAX_RADIUS_QUANTILE = 0.9
"""Quantile of all neighbor distances that bounds the radius of a splat, for isolated points."""


class Geometry(NamedTuple):
    """Colored triangle mesh, or a point cloud if there are no triangles."""

    points: Float64
    """(n, 3) float64 positions of the vertices or points, world frame."""
    colors: UInt8
    """(n, 3) uint8 RGB colors of the vertices or points."""
    triangles: Int64
    """(m, 3) int64 vertex indices of the triangles; (0, 3) for a point cloud."""


class Rendering(NamedTuple):
    """Rendered colors and depth of one image."""

    colors: Float32
    """(h, w, 3) float32 RGB colors in [0, 255], 0 at uncovered pixels."""
    depth: Float32
    """(h, w) float32 z-depth in world units, infinite at uncovered pixels."""

    @property
    def covered(self) -> Bool:
        """(h, w) bool mask of the pixels that a triangle or point covers."""
        mask: Bool = np.isfinite(self.depth)
        return mask


def splat_radii(points: Float64) -> Float64:
    """Compute the radius (n,) of each point's splat in world units.

    The radius is the distance of the fourth nearest neighbor, at most the 90th percentile of all
    these distances, so that splats of a regular grid overlap.
    """
    if len(points) < 2:
        return np.zeros(len(points))
    count = min(_NUM_NEIGHBORS + 1, len(points))
    distances, _ = cKDTree(points).query(points, k=count, workers=-1)
    farthest = distances[:, -1]
    radii: Float64 = np.minimum(farthest, np.quantile(farthest, _MAX_RADIUS_QUANTILE))
    return radii


def render(
    geometry: Geometry, camera: PinholeCamera, pose: Pose, radii: Float64 | None = None
) -> Rendering:
    """Render a mesh or point cloud with a z-buffer.

    Triangles are filled with perspective-correct interpolation of the vertex colors. A point is a
    square parallel to the image, and overlapping squares of one surface are blended.

    Args:
        geometry: Triangle mesh, or point cloud if there are no triangles.
        camera: Intrinsics and size of the rendered image.
        pose: ``cam_from_world`` as rotation (3, 3) and translation (3,).
        radii: (n,) half side length of the squares of a point cloud in world units; default:
            :func:`splat_radii`. Meshes ignore the radii.
    """
    local = transform(*pose, geometry.points)
    if len(geometry.triangles):
        colors = geometry.colors.astype(np.float32)
        depth, colors = rasterize(local, colors, geometry.triangles, camera.params, camera.size)
        return Rendering(colors, depth)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    colors = np.zeros((camera.height, camera.width, 3), np.float32)
    radii = splat_radii(geometry.points) if radii is None else radii
    _splat_points(local, geometry.colors, radii, camera.params, depth, colors)
    return Rendering(colors, depth)


@kernel()
def _splat_points(
    points: Float64,
    point_colors: UInt8,
    radii: Float64,
    camera: Float64,
    depth: Float32,
    colors: Float32,
) -> None:
    """Draw points in front of the camera as squares, blended with points of the same surface.

    Args:
        points: (n, 3) points, camera frame.
        point_colors: (n, 3) RGB.
        radii: (n,) half side lengths of the squares in world units.
        camera: (4,) intrinsics fx, fy, cx, cy in pixels.
        depth: (h, w) z-buffer, updated in place.
        colors: (h, w, 3) colors, 0 at first and updated in place. The color of a pixel is the
            weighted mean over the points at most their radius behind the nearest point.
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera
    total = np.zeros((height, width))
    for blends in (False, True):  # The second pass needs the nearest depth of all points.
        for n in range(len(points)):
            z = points[n, 2]
            if z <= 0:
                continue
            x, y = fx * points[n, 0] / z + cx, fy * points[n, 1] / z + cy
            # A square covers at least the pixel that contains the point.
            rx, ry = max(0.5, fx * radii[n] / z), max(0.5, fy * radii[n] / z)
            left, right = covered_range(x - rx, x + rx, width)
            top, bottom = covered_range(y - ry, y + ry, height)
            for i in range(top, bottom):
                for j in range(left, right):
                    if not blends:
                        depth[i, j] = min(depth[i, j], np.float32(z))
                    elif z - radii[n] <= depth[i, j]:
                        dx, dy = (j + 0.5 - x) / rx, (i + 0.5 - y) / ry
                        weight = math.exp(-2 * (dx * dx + dy * dy))
                        total[i, j] += weight
                        for k in range(3):
                            colors[i, j, k] += weight * point_colors[n, k]
    for i in range(height):
        for j in range(width):
            if total[i, j] > 0:
                for k in range(3):
                    colors[i, j, k] /= total[i, j]
