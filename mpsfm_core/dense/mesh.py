"""One triangle mesh from the depth maps of all images.

The maps are joined in a truncated signed distance field (Curless and Levoy, SIGGRAPH 1996), each
pixel with the weight that its variance gives it. The field is made block by block, only where a
surface is, so that memory does not grow with the scene; scikit-image turns blocks into triangles.
"""
# mypy: allow-untyped-decorators

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Bool, Float32, Float64, Int64, UInt8, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.fusion import consistent_pixels
from mpsfm_core.dense.options import MeshOptions
from mpsfm_core.geometry import (
    camera_center,
    inside,
    pixel_centers,
    project,
    resize_map,
    sample_nearest,
    transform,
    unproject,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.support.jit import kernel

_BLOCK = 64
"""Voxels along a side of a block."""
_BAND_VOXELS = 3.0
"""Half the width of the field around a surface at least, in voxels: a cell and its neighbours."""
_BAND_STDS = 3.0
"""The same in std of the depth: noise must not make two surfaces of one."""
_SAME_VERTEX = 1e-3
"""Distance in voxels below which vertices of neighbouring blocks are one: rounding of float32."""
_CORNERS = np.array(list(product((0.0, 1.0), repeat=3)))


class TriangleMesh(NamedTuple):
    """``vertices``: (n, 3) float64, world. ``triangles``: (m, 3) int64, rows of the vertices,
    anticlockwise as the cameras saw them. ``colors``: (n, 3) uint8, RGB."""

    vertices: Float64
    triangles: Int64
    colors: UInt8


class _Map(NamedTuple):
    """A depth map as the field takes it: 0 where there is none; weights are 1 / variance."""

    image: RegisteredImage
    intrinsics: Float64
    depth: Float32
    weight: Float32

    @property
    def points(self) -> Float64:
        """World points (n, 3)."""
        height, width = self.depth.shape
        known = self.depth > 0
        xy = pixel_centers(width, height)[known]
        camera = self.image.camera.resized(width, height)
        rotation, translation = self.image.rotation, self.image.translation
        local = unproject(camera, xy, self.depth[known])
        points: Float64 = local @ rotation + camera_center(rotation, translation)
        return points

    def showing(self, vertices: Float64, tolerance: float) -> tuple[Int64, Float64]:
        """Rows of the vertices (n, 3) that this map has, and their pixels (k, 2).

        Behind the edge of an object the field ends in a wall as long as it is wide, for some images
        look past the edge and the others do not know what is behind: no map has it.
        ``tolerance``: of depth, besides that of its std.
        """
        height, width = self.depth.shape
        local = transform(self.image.rotation, self.image.translation, vertices)
        xy = project(self.image.camera.resized(width, height), local)
        rows = np.flatnonzero(inside(xy, (width, height)) & (local[:, 2] > 0))
        depth, weight = (sample_nearest(grid, xy[rows]) for grid in (self.depth, self.weight))
        allowed = np.maximum(tolerance, _BAND_STDS / np.sqrt(np.where(weight > 0, weight, np.inf)))
        rows = rows[(depth > 0) & (np.abs(depth - local[rows, 2]) <= allowed)]
        return rows, xy[rows]

    def may_see(self, low: Float64, high: Float64) -> bool:
        """Whether a box may lie in the image; False only if it surely does not."""
        corners = low + _CORNERS * (high - low)
        local = transform(self.image.rotation, self.image.translation, corners)
        if (local[:, 2] <= 0).any():
            return bool((local[:, 2] > 0).any())
        height, width = self.depth.shape
        xy = project(self.image.camera.resized(width, height), local)
        return bool((xy.max(axis=0) > 0).all() and (xy.min(axis=0) < (width, height)).all())


def mesh_depth_maps(
    reconstruction: Reconstruction, view_of: Callable[[str], View], options: MeshOptions
) -> TriangleMesh:
    """The surface that the maps agree on, open where no image looks.

    ``view_of``: undistorted view by name, for the colours. Uncertain pixels and those that other
    images see through are left out, as they are of the cloud.

    Raises:
        InputError: scikit-image is not installed, no pixel is certain, or no surface is found.
    """
    marching_cubes, simplify = _libraries()
    images = reconstruction.confirmed_images
    maps = [
        _map(image, mask)
        for image, mask in zip(images, consistent_pixels(images, ResultOptions()), strict=True)
        if mask.any()
    ]
    if not maps:
        raise InputError("no pixel of the depth maps is certain, so there is no surface")
    pixel = np.median([np.median(m.depth[m.depth > 0]) / m.intrinsics[0] for m in maps])
    std = np.median([np.median(m.weight[m.depth > 0] ** -0.5) for m in maps])
    voxel = float(options.voxel_px * pixel)
    band = max(_BAND_VOXELS * voxel, _BAND_STDS * float(std))
    pieces = [_surface(maps, block, voxel, band, marching_cubes) for block in _blocks(maps, voxel)]
    vertices, triangles = _joined([piece for piece in pieces if piece is not None], voxel)
    shown = np.zeros(len(vertices), np.bool_)
    for each in maps:
        shown[each.showing(vertices, voxel)[0]] = True
    triangles = triangles[shown[triangles].all(axis=1)]
    triangles = _without_islands(vertices, triangles, band)
    if not len(triangles):
        raise InputError("the depth maps have no surface in common")
    vertices, triangles = _used(vertices, triangles)
    if len(triangles) > options.max_triangles:
        points, faces = simplify(
            vertices.astype(np.float32),
            triangles.astype(np.int32),
            target_count=options.max_triangles,
        )
        vertices, triangles = points.astype(np.float64), faces.astype(np.int64)
    return TriangleMesh(vertices, triangles, _colors(vertices, maps, view_of, voxel))


def _libraries() -> tuple[Any, Any]:
    try:
        from fast_simplification import simplify
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InputError(
            f"a mesh needs scikit-image and fast-simplification ({error}): "
            "pip install 'mpsfm-core[mesh]'"
        ) from error
    return marching_cubes, simplify


def _map(image: RegisteredImage, mask: Bool) -> _Map:
    height, width = image.depth.shape
    variance = image.depth.variance
    assert variance is not None  # of a refined map always
    smallest = np.finfo(np.float32).tiny
    weight = np.where(mask, 1 / np.maximum(variance, smallest), 0).astype(np.float32)
    depth = np.where(mask, image.depth.depth, 0).astype(np.float32)
    return _Map(image, image.camera.resized(width, height).params, depth, weight)


def _blocks(maps: Sequence[_Map], voxel: float) -> Int64:
    """Those (b, 3) that have a point, in a fixed order."""
    found = [np.zeros((0, 3), np.int64)]
    for each in maps:
        # a point at a face counts for both sides: the surface may pass on the other one
        points = each.points / (voxel * _BLOCK)
        shifted = [np.floor(points + (corner - 0.5) / _BLOCK) for corner in _CORNERS]
        found.append(np.unique(np.concatenate(shifted).astype(np.int64), axis=0))
    blocks: Int64 = np.unique(np.concatenate(found), axis=0)
    return blocks


def _surface(
    maps: Sequence[_Map], block: Int64, voxel: float, band: float, marching_cubes: Any
) -> tuple[Float64, Int64] | None:
    """Vertices and triangles of a block; None without a surface."""
    origin: Float64 = (block * (voxel * _BLOCK)).astype(np.float64)
    size = _BLOCK + 1
    total = np.zeros((size, size, size), np.float32)
    weight = np.zeros_like(total)
    for each in maps:
        if each.may_see(origin - band, origin + voxel * _BLOCK + band):
            rotation, translation = each.image.rotation, each.image.translation
            camera, grids = each.intrinsics, (each.depth, each.weight)
            _integrate(origin, voxel, rotation, translation, camera, *grids, band, total, weight)
    seen = weight > 0
    field = np.where(seen, total / np.where(seen, weight, 1), np.float32(band))
    if not (field[seen] < 0).any() or not (field[seen] > 0).any():
        return None
    try:
        # anticlockwise from where the field is positive, which is the cameras' side
        vertices, triangles, *_ = marching_cubes(field, 0.0, mask=seen)
    except (ValueError, RuntimeError):  # no cell whose corners were all seen has a surface
        return None
    return origin + voxel * vertices.astype(np.float64), triangles.astype(np.int64)


@kernel()
def _integrate(
    origin: Float64,
    voxel: float,
    rotation: Float64,
    translation: Float64,
    camera: Float64,
    depth: Float32,
    pixel_weight: Float32,
    band: float,
    total: Float32,
    weight: Float32,
) -> None:
    """Add what a map says: weighted distance along the ray to its surface, and the weight.

    ``camera``: fx, fy, cx, cy on the map's grid. ``total``, ``weight``: (n, n, n), changed.
    """
    height, width = depth.shape
    a, b, c = total.shape
    fx, fy, cx, cy = camera
    for i in range(a):
        for j in range(b):
            x, y, z = origin[0] + voxel * i, origin[1] + voxel * j, origin[2]
            u0 = rotation[0, 0] * x + rotation[0, 1] * y + translation[0]
            v0 = rotation[1, 0] * x + rotation[1, 1] * y + translation[1]
            w0 = rotation[2, 0] * x + rotation[2, 1] * y + translation[2]
            for k in range(c):
                at = z + voxel * k
                w = w0 + rotation[2, 2] * at
                if w <= 0:
                    continue
                u = fx * (u0 + rotation[0, 2] * at) / w + cx
                v = fy * (v0 + rotation[1, 2] * at) / w + cy
                if not (0 <= u < width and 0 <= v < height):
                    continue
                row, column = int(v), int(u)
                ahead = depth[row, column] - w
                if depth[row, column] <= 0 or ahead < -band:
                    continue
                here = pixel_weight[row, column]
                total[i, j, k] += here * min(ahead, band)
                weight[i, j, k] += here


def _joined(pieces: Sequence[tuple[Float64, Int64]], voxel: float) -> tuple[Float64, Int64]:
    """The blocks' surfaces as one: vertices on faces between blocks are in both."""
    if not pieces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces[:-1])])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    triangles = np.concatenate([t + s for (_, t), s in zip(pieces, starts, strict=True)])
    cells = np.round(vertices / (voxel * _SAME_VERTEX)).astype(np.int64)
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    triangles = number.ravel()[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return vertices[first], triangles[~flat]


def _without_islands(vertices: Float64, triangles: Int64, band: float) -> Int64:
    """Without connected pieces that are no larger than the field is wide: they may be noise."""
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((np.ones(len(edges), np.bool_), edges.T), shape=(len(vertices),) * 2)
    count, piece = connected_components(links, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, vertices)
    np.maximum.at(high, piece, vertices)
    large = (high - low).max(axis=1) > 2 * band
    kept: Int64 = triangles[large[piece[triangles[:, 0]]]]
    return kept


def _used(vertices: Float64, triangles: Int64) -> tuple[Float64, Int64]:
    """Without the vertices that no triangle has."""
    rows, numbers = np.unique(triangles, return_inverse=True)
    return vertices[rows], numbers.reshape(triangles.shape)


def _colors(
    vertices: Float64, maps: Sequence[_Map], view_of: Callable[[str], View], tolerance: float
) -> UInt8:
    """Mean colour in the images that show a vertex, weighted as their depth; else grey."""
    total = np.zeros((len(vertices), 3))
    weight = np.zeros(len(vertices))
    for each in maps:
        rows, xy = each.showing(vertices, tolerance)
        height, width = each.depth.shape
        here = sample_nearest(each.weight, xy).astype(np.float64)
        photo = resize_map(view_of(each.image.name).image, width, height)
        total[rows] += here[:, None] * sample_nearest(photo, xy)
        weight[rows] += here
    grey = np.full((len(vertices), 3), 128.0)
    mean = np.divide(total, weight[:, None], out=grey, where=weight[:, None] > 0)
    colors: UInt8 = np.round(mean).astype(np.uint8)
    return colors
