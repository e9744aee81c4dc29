"""Triangle mesh from the depth maps of all images.

Depth maps are integrated into a truncated signed distance field (TSDF) with inverse-variance
weights [Curless and Levoy, SIGGRAPH 1996]. Distances along z are converted to distances along the
surface normal, so that surfaces at grazing angles have no holes. Pixels in closed holes
(:mod:`~mpsfm_core.dense.hole_filling`) only have an effect where nothing is measured and no other
image sees through them. TSDF blocks exist only around surfaces, so that memory does not grow with
the volume. The voxels of large scenes are larger, so that the number of triangles that marching
cubes of scikit-image extracts is bounded.
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
from mpsfm_core.dense.depth_sampling import compute_slant, interpolate_depth, sample_depth
from mpsfm_core.dense.fusion import count_consistent_views, find_seen_through, select_voters
from mpsfm_core.dense.hole_filling import MAX_STEP, find_closable_holes
from mpsfm_core.dense.mesh_visibility import find_observed_triangles
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
from mpsfm_core.geometry.statistics import unique_rows
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.disk_arrays import current_store
from mpsfm_core.support.jit import kernel
from mpsfm_core.support.threads import parallel_map

_BLOCK_SIZE = 64
"""Number of voxels along each side of a TSDF block."""
_MAX_CELLS_PER_TRIANGLE = 2.0
"""Maximum number of voxels with points per triangle of the simplified mesh, above which voxels are
larger."""
_CELL_EXPONENT = 0.6
"""Exponent of the ratio of numbers of voxels by which voxels are larger: above 0.5, the exponent of
smooth surfaces, as the depth maps of a noisy surface fill more voxels."""
_CELL_SAMPLING = 64
"""Number of voxels with points per voxel that the estimate of their number counts."""
_HASH_FACTORS = np.array([73856093, 19349663, 83492791])
"""Factors of the spatial hash [Teschner et al. 2003]."""
_TRUNCATION_VOXELS = 3.0
"""Minimum truncation distance of the TSDF in voxels."""
_TRUNCATION_STDS = 3.0
"""Minimum truncation distance of the TSDF in depth stds, so that noise does not split a surface."""
_FILLED_WEIGHT_RATIO = 1e-6
"""Ratio of the weight of pixels in closed holes to the smallest weight of measured pixels."""
_MERGE_DISTANCE = 1e-3
"""Distance in voxels below which vertices of neighboring TSDF blocks merge, above float32
rounding."""
_CORNERS = np.array(list(product((0.0, 1.0), repeat=3)))


class TriangleMesh(NamedTuple):
    """Triangle mesh with vertex colors."""

    vertices: Float64
    """(n, 3) float64 positions of the vertices, world frame."""
    triangles: Int64
    """(m, 3) int64 vertex indices of the triangles, counterclockwise as seen by the cameras."""
    colors: UInt8
    """(n, 3) uint8 RGB colors of the vertices."""
    filled: Bool
    """(n,) mask of the vertices in closed holes, whose position comes from depth priors only."""

    @property
    def filled_triangles(self) -> Bool:
        """(m,) mask of the triangles with a vertex in a closed hole."""
        mask: Bool = np.logical_or.reduce(self.filled[self.triangles], axis=1)
        return mask


class _WeightedDepth(NamedTuple):
    """Depth map with inverse variances, for TSDF integration."""

    image: RegisteredImage
    intrinsics: Float64
    """(4,) intrinsics fx, fy, cx, cy in pixels of the depth map."""
    depth: Float32
    """(h, w) z-depth in world units, 0 at holes."""
    weight: Float32
    """(h, w) inverse variance of depth, 0 at holes and close to 0 in closed holes."""
    slant: Float32
    """(h, w) distance to the surface along its normal per distance along z, see
    :func:`compute_slant`."""
    filled: Bool
    """(h, w) mask of the pixels in closed holes."""

    @property
    def points(self) -> Float64:
        """(n, 3) world points of all pixels with depth."""
        height, width = self.depth.shape
        valid = self.depth > 0
        xy = pixel_centers(width, height)[valid]
        camera = self.image.camera.resized(width, height)
        rotation, translation = self.image.rotation, self.image.translation
        local = unproject(camera, xy, self.depth[valid])
        points: Float64 = local @ rotation + camera_center(rotation, translation)
        return points

    def find_visible(self, vertices: Float64, tolerance: float) -> tuple[Int64, Float64]:
        """Find the mesh vertices on the surface of the depth map.

        Behind object edges the TSDF contains false surfaces, because only some images have depth
        behind the edge. No depth map contains the false surfaces of the TSDF, so the comparison
        with depth maps rejects vertices on false surfaces.

        Args:
            vertices: (n, 3) positions of the vertices, world frame.
            tolerance: Minimum depth tolerance in world units; the depth std may raise the
                tolerance.

        Returns:
            Indices (k,) of the vertices on the surface, and their pixels (k, 2).
        """
        height, width = self.depth.shape
        local = transform(self.image.rotation, self.image.translation, vertices)
        xy = project(self.image.camera.resized(width, height), local)
        rows = np.flatnonzero(inside(xy, (width, height)) & (local[:, 2] > 0))
        weight = sample_nearest(self.weight, xy[rows])
        depth = sample_depth(self.depth, xy[rows])
        certain = (weight > 0) & ~sample_nearest(self.filled, xy[rows])
        std_tolerance = _TRUNCATION_STDS / np.sqrt(np.where(certain, weight, np.inf))
        max_difference = np.maximum(tolerance, std_tolerance)
        distance = np.abs(depth - local[rows, 2]) * sample_nearest(self.slant, xy[rows])
        rows = rows[(depth > 0) & (distance <= max_difference)]
        return rows, xy[rows]

    def may_see(self, low: Float64, high: Float64) -> bool:
        """Return False if a box between two world corners certainly projects outside the image."""
        corners = low + _CORNERS * (high - low)
        local = transform(self.image.rotation, self.image.translation, corners)
        if (local[:, 2] <= 0).any():
            return bool((local[:, 2] > 0).any())
        height, width = self.depth.shape
        xy = project(self.image.camera.resized(width, height), local)
        return bool((xy.max(axis=0) > 0).all() and (xy.min(axis=0) < (width, height)).all())


def mesh_depth_maps(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: MeshOptions,
) -> TriangleMesh:
    """Extract a triangle mesh from all depth maps, without triangles that no image observes.

    The mesh omits pixels with large depth std and inconsistent pixels, as the point cloud does.

    Args:
        reconstruction: Posed images with depth maps.
        view_of: Function that returns the undistorted view of an image name, for the colors.
        options: Options of mesh extraction.

    Raises:
        InputError: scikit-image is missing, no pixel has consistent depth, or no surface is found.
    """
    marching_cubes, simplify = _import_libraries()
    images = reconstruction.dense_images
    maps = _weight_depth_maps(images, options.max_hole_px)
    if not maps:
        raise InputError(
            "cannot build a mesh: no pixel of the depth maps is certain and consistent; "
            "run `mpsfm dense` first, or add photos with more overlap"
        )
    pixel_size = np.median([np.median(m.depth[m.depth > 0]) / m.intrinsics[0] for m in maps])
    std = np.median([np.median(m.weight[(m.depth > 0) & ~m.filled] ** -0.5) for m in maps])
    voxel = _bound_resolution(
        maps, float(options.voxel_px * pixel_size), _MAX_CELLS_PER_TRIANGLE * options.max_triangles
    )
    truncation = max(_TRUNCATION_VOXELS * voxel, _TRUNCATION_STDS * float(std))
    surfaces = parallel_map(
        lambda block: _extract_block_surface(maps, block, voxel, truncation, marching_cubes),
        _find_surface_blocks(maps, voxel),
    )
    vertices, triangles = _merge_surfaces([s for s in surfaces if s is not None], voxel)
    triangles = triangles[_find_visible_vertices(vertices, maps, voxel)[triangles].all(axis=1)]
    vertices, triangles = _remove_unused_vertices(vertices, triangles)
    # Noisy depth maps have hidden layers of surface behind or in front of each other.
    triangles = triangles[find_observed_triangles(vertices, triangles, images)]
    triangles = _remove_islands(vertices, triangles, truncation)
    if not len(triangles):
        raise InputError(
            "cannot build a mesh: the depth maps have no surface in common; "
            "add photos with more overlap"
        )
    vertices, triangles = _remove_unused_vertices(vertices, triangles)
    if len(triangles) > options.max_triangles:
        points, faces = simplify(
            vertices.astype(np.float32),
            triangles.astype(np.int32),
            target_count=options.max_triangles,
        )
        vertices, triangles = points.astype(np.float64), faces.astype(np.int64)
    colors, filled = _color_vertices(vertices, maps, view_of, voxel)
    return TriangleMesh(vertices, triangles, colors, filled)


def _import_libraries() -> tuple[Any, Any]:
    """Import `marching_cubes` (scikit-image) and `simplify` (fast-simplification)."""
    try:
        from fast_simplification import simplify
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InputError(
            f"cannot build a mesh: scikit-image or fast-simplification is missing ({error}); "
            "run pip install 'mpsfm-core[mesh]'"
        ) from error
    return marching_cubes, simplify


def _weight_depth_maps(
    images: Sequence[RegisteredImage], max_hole_px: float
) -> list[_WeightedDepth]:
    """Weight the consistent pixels and the pixels in closed holes of all images that have any."""
    voters = select_voters(images)
    counts = count_consistent_views(images, voters)
    confirmed = [views > 1 for views in counts]
    holes = [
        find_closable_holes(image.depth, mask, max_hole_px) & (views == 0)
        for image, mask, views in zip(images, confirmed, counts, strict=True)
    ]
    seen_through = find_seen_through(images, voters, confirmed, holes, MAX_STEP)
    return [
        _weight_depth(image, views > 0, hole & ~open_space)
        for image, views, hole, open_space in zip(images, counts, holes, seen_through, strict=True)
        if views.any()
    ]


def _weight_depth(image: RegisteredImage, mask: Bool, filled: Bool) -> _WeightedDepth:
    """Weight the pixels of a mask by their variance, and add the pixels in closed holes."""
    height, width = image.depth.shape
    variance = image.depth.variance
    assert variance is not None  # The mapper's refined depth maps always have a variance.
    min_variance = np.finfo(np.float32).tiny
    weight = np.where(mask, 1 / np.maximum(variance, min_variance), 0).astype(np.float32)
    weight[filled] = _FILLED_WEIGHT_RATIO * weight[mask].min()
    depth = np.where(mask | filled, image.depth.depth, 0).astype(np.float32)
    intrinsics = image.camera.resized(width, height).params
    slant = compute_slant(image.depth.depth, intrinsics)
    store = current_store()
    maps = store(depth), store(weight), store(slant), store(filled)
    return _WeightedDepth(image, intrinsics, *maps)


def _bound_resolution(maps: Sequence[_WeightedDepth], voxel: float, max_cells: float) -> float:
    """Enlarge the side length of voxels until at most `max_cells` of them contain points."""
    while (ratio := _estimate_num_cells(maps, voxel) / max_cells) > 1:
        voxel *= ratio**_CELL_EXPONENT
    return voxel


def _estimate_num_cells(maps: Sequence[_WeightedDepth], voxel: float) -> int:
    """Estimate the number of voxels with points from the voxels with few of all hash values."""
    sampled = [np.zeros((0, 3), np.int64)]
    for map_ in maps:
        cells = np.floor(map_.points / voxel).astype(np.int64)
        hashes = np.bitwise_xor.reduce(cells * _HASH_FACTORS, axis=1)
        sampled.append(cells[hashes % _CELL_SAMPLING == 0])
    return _CELL_SAMPLING * len(unique_rows(np.concatenate(sampled))[0])


def _find_surface_blocks(maps: Sequence[_WeightedDepth], voxel: float) -> Int64:
    """Return the sorted integer coordinates (b, 3) of the TSDF blocks that contain points."""
    blocks_per_map = [np.zeros((0, 3), np.int64)]
    for map_ in maps:
        # A point near a face between two TSDF blocks belongs to both, because the surface may be on
        # either side.
        points = map_.points / (voxel * _BLOCK_SIZE)
        low, high = (
            np.floor(points + shift / _BLOCK_SIZE).astype(np.int64) for shift in (-0.5, 0.5)
        )
        near_face = (low != high).any(axis=1)
        shifted = [np.where(corner > 0, high[near_face], low[near_face]) for corner in _CORNERS]
        blocks = np.concatenate([low[~near_face], *shifted])
        blocks_per_map.append(blocks[unique_rows(blocks)[0]])
    blocks = np.concatenate(blocks_per_map)
    return blocks[unique_rows(blocks)[0]]


def _extract_block_surface(
    maps: Sequence[_WeightedDepth],
    block: Int64,
    voxel: float,
    truncation: float,
    marching_cubes: Any,
) -> tuple[Float64, Int64] | None:
    """Integrate the TSDF of one block and extract its triangles.

    Returns:
        Vertices (n, 3) in the world frame and triangles (m, 3), or None without a surface.
    """
    origin: Float64 = (block * (voxel * _BLOCK_SIZE)).astype(np.float64)
    size = _BLOCK_SIZE + 1
    total = np.zeros((size, size, size), np.float32)
    weight = np.zeros_like(total)
    for map_ in maps:
        if map_.may_see(origin - truncation, origin + voxel * _BLOCK_SIZE + truncation):
            pose = map_.image.rotation, map_.image.translation
            camera, grids = map_.intrinsics, (map_.depth, map_.weight, map_.slant)
            _integrate(origin, voxel, *pose, camera, *grids, truncation, total, weight)
    observed = weight > 0
    field = np.where(observed, total / np.where(observed, weight, 1), np.float32(truncation))
    if not (field[observed] < 0).any() or not (field[observed] > 0).any():
        return None
    try:
        # Triangles are counterclockwise when seen from the side of the cameras, where signed
        # distances are positive.
        vertices, triangles, *_ = marching_cubes(field, 0.0, mask=observed)
    except (ValueError, RuntimeError):  # No observed voxel of the TSDF block contains a surface.
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
    slant: Float32,
    truncation: float,
    total: Float32,
    weight: Float32,
) -> None:
    """Integrate one depth map into the TSDF of a block.

    Args:
        origin: (3,) position of the block's first voxel in the world frame.
        voxel: Side length of a voxel in world units.
        rotation: (3, 3) rotation of ``cam_from_world``.
        translation: (3,) of ``cam_from_world``.
        camera: (4,) intrinsics fx, fy, cx, cy in pixels of the depth map.
        depth: (h, w) z-depth in world units, 0 at holes.
        pixel_weight: (h, w) weights.
        slant: (h, w) distance along the normal of the surface per distance along z.
        truncation: Truncation distance of the TSDF in world units.
        total: (n, n, n) weighted sum of signed distances of each voxel, updated in place.
        weight: (n, n, n) sum of weights of each voxel, updated in place.
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
                pixel_depth = interpolate_depth(depth, u, v)
                distance = (pixel_depth - w) * slant[int(v), int(u)]
                if pixel_depth <= 0 or distance < -truncation:
                    continue
                w_pixel = pixel_weight[int(v), int(u)]
                total[i, j, k] += w_pixel * min(distance, truncation)
                weight[i, j, k] += w_pixel


def _merge_surfaces(
    surfaces: Sequence[tuple[Float64, Int64]], voxel: float
) -> tuple[Float64, Int64]:
    """Merge the triangles of all TSDF blocks at the vertices on their common faces."""
    if not surfaces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces[:-1])])
    vertices = np.concatenate([vertices for vertices, _ in surfaces])
    triangles = np.concatenate([t + s for (_, t), s in zip(surfaces, starts, strict=True)])
    cells = np.round(vertices / (voxel * _MERGE_DISTANCE)).astype(np.int64)
    first, vertex_ids = unique_rows(cells)
    triangles = vertex_ids[triangles]
    degenerate = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return vertices[first], triangles[~degenerate]


def _find_visible_vertices(
    vertices: Float64, maps: Sequence[_WeightedDepth], tolerance: float
) -> Bool:
    """Return the mask (n,) of the vertices on the surface of a depth map."""
    visible = np.zeros(len(vertices), np.bool_)

    def mark_visible(map_: _WeightedDepth) -> None:
        visible[map_.find_visible(vertices, tolerance)[0]] = True

    parallel_map(mark_visible, maps)
    return visible


def _remove_islands(vertices: Float64, triangles: Int64, truncation: float) -> Int64:
    """Remove connected mesh components no larger than the TSDF truncation band (noise)."""
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((np.ones(len(edges), np.bool_), edges.T), shape=(len(vertices),) * 2)
    count, component = connected_components(links, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, component, vertices)
    np.maximum.at(high, component, vertices)
    large = (high - low).max(axis=1) > 2 * truncation
    filtered: Int64 = triangles[large[component[triangles[:, 0]]]]
    return filtered


def _remove_unused_vertices(vertices: Float64, triangles: Int64) -> tuple[Float64, Int64]:
    """Remove mesh vertices that no triangle uses."""
    rows, vertex_ids = np.unique(triangles, return_inverse=True)
    return vertices[rows], vertex_ids.reshape(triangles.shape)


def _color_vertices(
    vertices: Float64,
    maps: Sequence[_WeightedDepth],
    view_of: Callable[[str], View],
    tolerance: float,
) -> tuple[UInt8, Bool]:
    """Average the colors of each vertex over images, and find the vertices in closed holes.

    Returns:
        Colors (n, 3), gray if no image sees a vertex, and the mask (n,) of the vertices that images
        only see in closed holes.
    """
    total = np.zeros((len(vertices), 3))
    weight = np.zeros(len(vertices))
    measured, filled = np.zeros((2, len(vertices)), np.bool_)
    for map_ in maps:
        rows, xy = map_.find_visible(vertices, tolerance)
        height, width = map_.depth.shape
        map_weight = sample_nearest(map_.weight, xy).astype(np.float64)
        pixels = resize_map(view_of(map_.image.name).image, width, height)
        total[rows] += map_weight[:, None] * sample_nearest(pixels, xy)
        weight[rows] += map_weight
        in_hole = sample_nearest(map_.filled, xy)
        measured[rows[~in_hole]] = True
        filled[rows[in_hole]] = True
    gray = np.full((len(vertices), 3), 128.0)
    mean = np.divide(total, weight[:, None], out=gray, where=weight[:, None] > 0)
    return np.round(mean).astype(np.uint8), filled & ~measured
