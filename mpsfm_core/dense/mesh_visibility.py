"""Visibility of the triangles of a mesh in posed images, by rasterization with a z-buffer."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.dense.depth_sampling import sample_depth
from mpsfm_core.geometry import inside, project, transform
from mpsfm_core.geometry.rasterization import rasterize
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.support.jit import kernel
from mpsfm_core.support.threads import Result, parallel_map

_OCCLUSION_TOLERANCE_EDGES = 2.0
"""Depth tolerance of the occlusion test, in median edge lengths of the mesh."""


def find_observed_triangles(
    vertices: Float64, triangles: Int64, images: Sequence[RegisteredImage]
) -> Bool:
    """Find the triangles whose front an image observes.

    A triangle of which each vertex belongs to such a triangle counts as observed, because depth
    noise hides single triangles.

    Args:
        vertices: (n, 3) positions, world frame.
        triangles: (m, 3) vertex indices, counterclockwise as seen by the cameras.
        images: Posed images with depth maps, whose sizes are those of the occlusion test.

    Returns:
        Mask (m,) of the observed triangles.
    """
    vertex_observed = np.zeros(len(vertices), np.bool_)

    def mark_observed(_: RegisteredImage, areas: Float64) -> None:
        vertex_observed[triangles[areas > 0]] = True

    map_projected_areas(mark_observed, vertices, triangles, images, min_cosine=0.0)
    observed: Bool = np.logical_and.reduce(vertex_observed[triangles], axis=1)
    return observed


def map_projected_areas(
    function: Callable[[RegisteredImage, Float64], Result],
    vertices: Float64,
    triangles: Int64,
    images: Sequence[RegisteredImage],
    min_cosine: float,
) -> list[Result]:
    """Call a function on the projected areas of the triangles in each image, in threads.

    Args:
        function: Function of an image, and of the area (m,) of each triangle in pixels of the
            image, 0 if the triangle is not visible.
        vertices: (n, 3) positions, world frame.
        triangles: (m, 3) vertex indices, counterclockwise as seen by the cameras.
        images: Posed images with depth maps, whose sizes are those of the occlusion test.
        min_cosine: Minimum cosine of the angle between the normal of a visible triangle and the
            direction to the camera.

    Returns:
        The results of the function for each image.
    """
    edge_length = float(np.median(_edge_lengths(vertices, triangles)))

    def call(image: RegisteredImage) -> Result:
        local = transform(image.rotation, image.translation, vertices)
        xy = project(image.camera, local)
        visible = _find_visible(image, local, triangles, xy, edge_length)
        min_frontal_ratio = min_cosine * image.camera.fx * image.camera.fy
        areas = _project_triangles(local, xy, visible, triangles, min_frontal_ratio)
        return function(image, areas)

    return parallel_map(call, images)


@kernel()
def _edge_lengths(vertices: Float64, triangles: Int64) -> Float64:
    """Compute the lengths (m, 3) of the edges of triangles (m, 3)."""
    lengths = np.empty(triangles.shape)
    for m in range(len(triangles)):
        for k in range(3):
            a, b = triangles[m, k - 1], triangles[m, k]
            squared = 0.0
            for axis in range(3):
                squared += (vertices[b, axis] - vertices[a, axis]) ** 2
            lengths[m, k] = math.sqrt(squared)
    return lengths


@kernel()
def _project_triangles(
    local: Float64, xy: Float64, visible: Bool, triangles: Int64, min_frontal_ratio: float
) -> Float64:
    """Compute the projected area (m,) of each triangle, 0 if it is not visible.

    Args:
        local: (n, 3) vertices, camera frame.
        xy: (n, 2) pixels of the vertices.
        visible: (n,) mask of the visible vertices.
        triangles: (m, 3) vertex indices.
        min_frontal_ratio: Minimum projected area of visible triangles, in pixels, of a triangle of
            area 1 at depth 1.
    """
    areas = np.zeros(len(triangles))
    for m in range(len(triangles)):
        a, b, c = triangles[m]
        if not (visible[a] and visible[b] and visible[c]):
            continue
        ux, uy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        vx, vy = xy[c, 0] - xy[a, 0], xy[c, 1] - xy[a, 1]
        # In images, whose y axis points down, triangles that face the camera are clockwise.
        area = (vx * uy - vy * ux) / 2
        x0, x1 = local[b, 0] - local[a, 0], local[c, 0] - local[a, 0]
        y0, y1 = local[b, 1] - local[a, 1], local[c, 1] - local[a, 1]
        z0, z1 = local[b, 2] - local[a, 2], local[c, 2] - local[a, 2]
        normal = (y0 * z1 - z0 * y1) ** 2 + (z0 * x1 - x0 * z1) ** 2 + (x0 * y1 - y0 * x1) ** 2
        depth = (local[a, 2] + local[b, 2] + local[c, 2]) / 3
        if area > min_frontal_ratio * math.sqrt(normal) / 2 / max(depth, 1e-12) ** 2:
            areas[m] = area
    return areas


def _find_visible(
    image: RegisteredImage, local: Float64, triangles: Int64, xy: Float64, edge_length: float
) -> Bool:
    """Return the mask (n,) of the vertices that no triangle occludes and the image contains."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    no_attributes = np.zeros((len(local), 0), np.float32)
    nearest, _ = rasterize(local, no_attributes, triangles, camera.params, camera.size)
    visible: Bool = inside(xy, image.camera.size) & (local[:, 2] > 0)
    rows = np.flatnonzero(visible)
    scaled = xy[rows] * (width / image.camera.width, height / image.camera.height)
    tolerance = _OCCLUSION_TOLERANCE_EDGES * edge_length
    visible[rows] = local[rows, 2] <= sample_depth(nearest, scaled) + tolerance
    return visible
