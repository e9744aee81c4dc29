"""Texture of a mesh from the photos.

Each triangle is textured by one photo. Connected triangles of the same photo form a chart, whose
texture is a rectangle of that photo. The rectangles of all charts are packed into one image.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Bool, Float32, Float64, Int64, UInt8, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.mesh import TriangleMesh
from mpsfm_core.dense.seam_leveling import level_seams
from mpsfm_core.dense.texture_views import NO_VIEW, find_neighbors, select_texture_views
from mpsfm_core.geometry import project, sample_nearest, transform
from mpsfm_core.geometry.rasterization import rasterize
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

_PADDING = 2
"""Width in pixels of the border around a chart, for bilinear interpolation and mipmaps."""
_MIN_SCALE = 0.01
"""Scale of the photos below which the texture does not show anything."""
_SEAM_BLUR_PX = 2.0
"""Standard deviation in pixels of the Gaussian blur of the colors that seam leveling compares."""


class TexturedMesh(NamedTuple):
    """Triangle mesh with one texture image."""

    vertices: Float64
    """(n, 3) float64 positions, world frame. Vertices on a seam are repeated."""
    triangles: Int64
    """(m, 3) int64 vertex indices, counterclockwise as seen by the cameras."""
    uv: Float32
    """(n, 2) float32 texture coordinates in [0, 1], from the upper left corner of the texture."""
    texture: UInt8
    """(h, w, 3) uint8 RGB texture."""
    filled: Bool
    """(m,) mask of the triangles in closed holes, see :attr:`TriangleMesh.filled`."""


class _Charts(NamedTuple):
    """Charts of a mesh, and their corners: the vertices of each chart."""

    views: Int64
    """(c,) photo of each chart, or :data:`NO_VIEW`."""
    chart_of: Int64
    """(k,) chart of each corner."""
    vertex_of: Int64
    """(k,) mesh vertex of each corner."""
    triangles: Int64
    """(m, 3) corner indices of the triangles."""


class _Layout(NamedTuple):
    """Rectangles of the charts in their photos and in the texture."""

    scale: float
    """Size of the photos in the texture relative to their original size."""
    low: Int64
    """(c, 2) upper left pixel (x, y) of each rectangle in its scaled photo."""
    size: Int64
    """(c, 2) width and height of each rectangle in pixels."""
    origin: Int64
    """(c, 2) upper left pixel (x, y) of each rectangle in the texture."""
    texture_size: tuple[int, int]
    """Width and height of the texture in pixels."""


def build_texture(
    mesh: TriangleMesh,
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    max_size: int,
) -> TexturedMesh:
    """Texture a mesh with the photos of the images with confirmed pose.

    A triangle that no photo observes has the mean vertex color of its chart.

    Args:
        mesh: Mesh in the world frame of the reconstruction.
        reconstruction: Posed images with depth maps.
        view_of: Function that returns the undistorted view of an image name.
        max_size: Maximum side of the texture in pixels. Photos are reduced if necessary.

    Raises:
        InputError: The charts do not fit into the texture.
    """
    images = reconstruction.dense_images
    labels = select_texture_views(mesh.vertices, mesh.triangles, images, view_of)
    charts = _build_charts(mesh.triangles, labels)
    xy = _project_corners(mesh.vertices, charts, images)
    layout = _lay_out(charts, xy, max_size)
    texture = np.zeros((*layout.texture_size[::-1], 3), np.uint8)
    colors = mesh.colors[charts.vertex_of].astype(np.float64)
    for view, image in enumerate(images):
        _copy_photo(view_of(image.name), view, charts, layout, xy, texture, colors)
    _fill_unseen(charts, layout, colors, texture)
    shifts = (layout.origin - layout.low)[charts.chart_of]
    positions = xy * layout.scale + shifts
    _level_texture(charts, colors, positions, texture)
    uv = (positions / layout.texture_size).astype(np.float32)
    vertices = mesh.vertices[charts.vertex_of]
    return TexturedMesh(vertices, charts.triangles, uv, texture, mesh.filled_triangles)


def _build_charts(triangles: Int64, labels: Int64) -> _Charts:
    neighbors = find_neighbors(triangles)
    same = (neighbors >= 0) & (labels[neighbors] == labels[:, None])
    rows, edges = np.nonzero(same)
    links = coo_array(
        (np.ones(len(rows), np.bool_), (rows, neighbors[rows, edges])), shape=(len(labels),) * 2
    )
    count, chart_of_triangle = connected_components(links, directed=False)
    views = np.full(count, NO_VIEW, np.int64)
    views[chart_of_triangle] = labels
    size = int(triangles.max()) + 1
    keys = chart_of_triangle[:, None].astype(np.int64) * size + triangles
    corners, inverse = np.unique(keys, return_inverse=True)
    return _Charts(views, corners // size, corners % size, inverse.reshape(-1, 3))


def _project_corners(
    vertices: Float64, charts: _Charts, images: tuple[RegisteredImage, ...]
) -> Float64:
    """Project each corner (k, 2) into the photo of its chart; zero for charts without photo."""
    xy = np.zeros((len(charts.chart_of), 2))
    view_of_corner = charts.views[charts.chart_of]
    for view, image in enumerate(images):
        rows = np.flatnonzero(view_of_corner == view)
        local = transform(image.rotation, image.translation, vertices[charts.vertex_of[rows]])
        xy[rows] = project(image.camera, local)
    return xy


def _lay_out(charts: _Charts, xy: Float64, max_size: int) -> _Layout:
    """Choose the largest scale of the photos at which the rectangles fit into the texture."""
    scale = 1.0
    while True:
        low = np.full((len(charts.views), 2), np.inf)
        high = np.full_like(low, -np.inf)
        np.minimum.at(low, charts.chart_of, scale * xy)
        np.maximum.at(high, charts.chart_of, scale * xy)
        first = np.floor(low).astype(np.int64) - _PADDING
        size = np.ceil(high).astype(np.int64) + _PADDING - first
        side = math.ceil(math.sqrt(float(size.prod(axis=1).sum())))
        width = min(max_size, max(side, int(size[:, 0].max())))
        origin, height = _pack(size, width)
        if height <= max_size and size[:, 0].max() <= width:
            return _Layout(scale, first, size, origin, (width, height))
        scale *= min(0.95, math.sqrt(max_size / height))
        if scale < _MIN_SCALE:
            raise InputError(
                f"the texture of {len(charts.views)} charts does not fit into {max_size} x "
                f"{max_size} pixels; raise max_texture_size or lower max_triangles"
            )


def _pack(sizes: Int64, width: int) -> tuple[Int64, int]:
    """Pack rectangles into shelves of decreasing height; return their origins and the height."""
    origin = np.zeros_like(sizes)
    x = y = shelf = 0
    for row in np.lexsort((sizes[:, 0], -sizes[:, 1])):
        if x + sizes[row, 0] > width:
            x, y, shelf = 0, y + shelf, 0
        origin[row] = x, y
        x, shelf = x + int(sizes[row, 0]), max(shelf, int(sizes[row, 1]))
    return origin, y + shelf


def _copy_photo(
    view: View,
    number: int,
    charts: _Charts,
    layout: _Layout,
    xy: Float64,
    texture: UInt8,
    colors: Float64,
) -> None:
    """Copy the rectangles of one photo into the texture, and sample the colors of its corners."""
    rows = np.flatnonzero(charts.views == number)
    if not len(rows):
        return
    photo = view.image
    if layout.scale < 1:
        # Without a size, OpenCV does not round the factor to a ratio of whole sizes.
        factor = layout.scale
        photo = cv2.resize(photo, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    corners = np.flatnonzero(charts.views[charts.chart_of] == number)
    blurred = cv2.GaussianBlur(photo, (0, 0), _SEAM_BLUR_PX)
    colors[corners] = sample_nearest(blurred, layout.scale * xy[corners])
    # Two more pixels, because the scaled photo is rounded to whole pixels.
    border = _PADDING + 2
    padded = cv2.copyMakeBorder(photo, *(border,) * 4, cv2.BORDER_REPLICATE)
    for row in rows:
        (left, top), (width, height) = layout.low[row] + border, layout.size[row]
        x, y = layout.origin[row]
        part = padded[top : top + height, left : left + width]
        texture[y : y + part.shape[0], x : x + part.shape[1]] = part


def _fill_unseen(charts: _Charts, layout: _Layout, colors: Float64, texture: UInt8) -> None:
    """Fill the rectangles of charts without photo with their mean vertex color."""
    unseen = np.flatnonzero(charts.views == NO_VIEW)
    count = np.bincount(charts.chart_of, minlength=len(charts.views))
    sums = [np.bincount(charts.chart_of, c, minlength=len(charts.views)) for c in colors.T]
    mean = np.column_stack(sums) / count[:, None]
    for row in unseen:
        (x, y), (width, height) = layout.origin[row], layout.size[row]
        texture[y : y + height, x : x + width] = np.round(mean[row])


def _level_texture(charts: _Charts, colors: Float64, positions: Float64, texture: UInt8) -> None:
    """Add the color offsets of seam leveling to the texture, interpolated in each triangle."""
    seen = charts.views[charts.chart_of] != NO_VIEW
    offsets = np.zeros((len(colors), 3), np.float32)
    triangles = charts.triangles[seen[charts.triangles[:, 0]]]
    if not len(triangles):
        return
    numbers = np.cumsum(seen) - 1
    offsets[seen] = level_seams(colors[seen], charts.vertex_of[seen], numbers[triangles])
    flat = np.column_stack([positions, np.ones(len(positions))])
    size = texture.shape[1], texture.shape[0]
    depth, values = rasterize(flat, offsets, triangles, np.array([1.0, 1, 0, 0]), size)
    inside = np.isfinite(depth)
    # Pixels around a chart get the mean offset of the chart's pixels nearby.
    side = 2 * _PADDING + 1
    weight = cv2.blur(inside.astype(np.float32), (side, side))[..., None]
    leveled = cv2.blur(values, (side, side))
    leveled /= np.maximum(weight, np.float32(1e-6))
    np.copyto(leveled, values, where=inside[..., None])
    leveled += texture
    texture[...] = np.clip(np.round(leveled, out=leveled), 0, 255, out=leveled)
