"""Visibility of the triangles of a mesh in posed images, by rasterization with a z-buffer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.dense.depth_sampling import sample_depth
from mpsfm_core.geometry import inside, project, transform
from mpsfm_core.geometry.rasterization import rasterize
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage

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
    for areas in projected_areas(vertices, triangles, images, min_cosine=0.0):
        vertex_observed[triangles[areas > 0]] = True
    observed: Bool = np.logical_and.reduce(vertex_observed[triangles], axis=1)
    return observed


def projected_areas(
    vertices: Float64, triangles: Int64, images: Sequence[RegisteredImage], min_cosine: float
) -> Iterator[Float64]:
    """Compute the area (m,) of each triangle in pixels of each image, 0 if it is not visible.

    Args:
        vertices: (n, 3) positions, world frame.
        triangles: (m, 3) vertex indices, counterclockwise as seen by the cameras.
        images: Posed images with depth maps, whose sizes are those of the occlusion test.
        min_cosine: Minimum cosine of the angle between the normal of a visible triangle and the
            direction to the camera.
    """
    edges = vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)]
    edge_length = float(np.median(np.linalg.norm(edges, axis=2)))
    world_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    for image in images:
        local = transform(image.rotation, image.translation, vertices)
        xy = project(image.camera, local)
        visible = _find_visible(image, local, triangles, xy, edge_length)
        a, b, c = (xy[triangles[:, k]] for k in range(3))
        # In images, whose y axis points down, triangles that face the camera are clockwise.
        area = ((c - a)[:, 0] * (b - a)[:, 1] - (c - a)[:, 1] * (b - a)[:, 0]) / 2
        depth = local[triangles, 2].mean(axis=1)
        frontal = world_area * image.camera.fx * image.camera.fy / np.maximum(depth, 1e-12) ** 2
        usable = visible[triangles].all(axis=1) & (area > min_cosine * frontal)
        yield np.where(usable, area, 0.0)


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
