"""Software rendering of point clouds and triangle meshes into pinhole cameras."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
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
    uv: Float32 | None = None
    """(n, 2) float32 texture coordinates of a mesh in [0, 1] from the upper left corner."""
    texture: UInt8 | None = None
    """(h, w, 3) uint8 RGB texture of a mesh, which is rendered instead of the vertex colors."""


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

    Triangles are filled with perspective-correct interpolation of the texture coordinates or vertex
    colors. A point is a square parallel to the image, and overlapping squares of one surface are
    blended.

    Args:
        geometry: Triangle mesh, or point cloud if there are no triangles.
        camera: Intrinsics and size of the rendered image.
        pose: ``cam_from_world`` as rotation (3, 3) and translation (3,).
        radii: (n,) half side length of the squares of a point cloud in world units; default:
            :func:`splat_radii`. Meshes ignore the radii.
    """
    local = transform(*pose, geometry.points)
    if len(geometry.triangles):
        values = geometry.colors.astype(np.float32) if geometry.uv is None else geometry.uv
        depth, values = rasterize(local, values, geometry.triangles, camera.params, camera.size)
        if geometry.uv is not None:
            values = _sample_texture(geometry.texture, values, np.isfinite(depth))
        return Rendering(values, depth)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    colors = np.zeros((camera.height, camera.width, 3), np.float32)
    radii = splat_radii(geometry.points) if radii is None else radii
    _splat_points(local, geometry.colors, radii, camera.params, depth, colors)
    return Rendering(colors, depth)


def _sample_texture(texture: UInt8 | None, uv: Float32, covered: Bool) -> Float32:
    """Sample a texture at the texture coordinates (h, w, 2) of the covered pixels, else 0.

    The texture is reduced to the resolution of the rendered image first, like a mipmap.
    """
    assert texture is not None
    height, width = texture.shape[:2]
    steps = [
        np.abs(np.diff(uv[..., axis], axis=1))[covered[:, 1:] & covered[:, :-1]] for axis in (0, 1)
    ]
    step = np.median(np.hypot(steps[0] * width, steps[1] * height)) if steps[0].size else 1.0
    # The ratio of whole sizes is the exact factor, as texture coordinates are relative to the size.
    size = [max(1, round(side / max(1.0, float(step)))) for side in (width, height)]
    small = cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
    xy = uv * np.array(small.shape[1::-1], np.float32) - np.float32(0.5)
    colors = cv2.remap(
        small, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    sampled: Float32 = np.where(covered[..., None], colors, 0).astype(np.float32)
    return sampled


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
