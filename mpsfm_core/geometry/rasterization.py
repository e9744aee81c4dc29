"""Rasterization of triangle meshes with a z-buffer."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_core.support.jit import helper, kernel


def rasterize(
    points: Float64,
    attributes: Float32,
    triangles: Int64,
    intrinsics: Float64,
    size: tuple[int, int],
) -> tuple[Float32, Float32]:
    """Fill the triangles of a mesh with perspective-correct interpolation of vertex attributes.

    Triangles that cross the plane z = 0 are omitted.

    Args:
        points: (n, 3) vertices in the camera frame.
        attributes: (n, c) values of the vertices, such as colors.
        triangles: (m, 3) vertex indices.
        intrinsics: (4,) fx, fy, cx, cy in pixels.
        size: Width and height of the image in pixels.

    Returns:
        Depth (h, w) of the nearest triangle in the unit of ``points``, infinite at uncovered
        pixels, and attributes (h, w, c), 0 at uncovered pixels.
    """
    width, height = size
    depth = np.full((height, width), np.inf, np.float32)
    values = np.zeros((height, width, attributes.shape[1]), np.float32)
    _fill_triangles(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(attributes, np.float32),
        np.ascontiguousarray(triangles, np.int64),
        np.asarray(intrinsics, np.float64),
        depth,
        values,
    )
    return depth, values


@helper()
def covered_range(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the first and the end of the pixels whose centers are in an interval."""
    first = math.ceil(min(max(low - 0.5, 0.0), float(size)))
    end = math.floor(max(min(high - 0.5, size - 1.0), -1.0)) + 1
    return first, end


@kernel()
def _fill_triangles(
    points: Float64,
    attributes: Float32,
    triangles: Int64,
    camera: Float64,
    depth: Float32,
    values: Float32,
) -> None:
    """Fill triangles in front of the camera into a z-buffer; omit triangles that cross z = 0.

    Args:
        points: (n, 3) vertices, camera frame.
        attributes: (n, c) values of the vertices.
        triangles: (m, 3) vertex indices.
        camera: (4,) intrinsics fx, fy, cx, cy in pixels.
        depth: (h, w) z-buffer, updated in place.
        values: (h, w, c) interpolated values of the nearest triangles, updated in place.
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera
    for m in range(len(triangles)):
        a, b, c = triangles[m]
        za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
        if za <= 0 or zb <= 0 or zc <= 0:
            continue
        xa, ya = fx * points[a, 0] / za + cx, fy * points[a, 1] / za + cy
        xb, yb = fx * points[b, 0] / zb + cx, fy * points[b, 1] / zb + cy
        xc, yc = fx * points[c, 0] / zc + cx, fy * points[c, 1] / zc + cy
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0:
            continue
        left, right = covered_range(min(xa, xb, xc), max(xa, xb, xc), width)
        top, bottom = covered_range(min(ya, yb, yc), max(ya, yb, yc), height)
        for i in range(top, bottom):
            y = i + 0.5
            for j in range(left, right):
                x = j + 0.5
                wa = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / area
                wb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / area
                wc = 1 - wa - wb
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                z = 1 / (wa / za + wb / zb + wc / zc)
                if z >= depth[i, j]:
                    continue
                depth[i, j] = z
                for k in range(attributes.shape[1]):
                    values[i, j, k] = z * (
                        wa * attributes[a, k] / za
                        + wb * attributes[b, k] / zb
                        + wc * attributes[c, k] / zc
                    )
