"""Two-view and three-view overlap from true depth or from a COLMAP model [paper, appendix].

The two-view overlap is the share of a view's pixels that are visible in the other view; the smaller
share of both views counts. The three-view overlap is the share of a view's pixels that are visible
in both other views; the largest share of the three views counts.

A pixel with true depth is visible in another view if the pixel projects into that view with
consistent depth. With a COLMAP model, the observed points of a view replace the pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float32, Float64, PinholeCamera, Pose, UInt8
from mpsfm_core.geometry import (
    inside,
    pixel_centers,
    project,
    resize_map,
    sample_nearest,
    transform,
    unproject,
)

DEPTH_TOLERANCE = 0.05
"""Maximum relative difference between the depth of a pixel projected into another view and the
depth map of that view."""
_GRID_COLUMNS = 96
"""Number of columns of the pixel grid on which depth maps are compared."""
_ONES: UInt8 = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(
    axis=1, dtype=np.uint8
)


@dataclass(frozen=True, eq=False)
class Overlap:
    """Two-view and three-view overlap of n views of a scene."""

    names: tuple[str, ...]
    """Names of the n views."""
    seen: tuple[UInt8, ...]
    """(n, bytes) uint8 visibility for each view; row j has one bit per pixel (or point) of the
    view, set if visible in view j."""
    counts: Float64
    """(n,) number of compared pixels (or points) of each view."""
    two_view: Float64
    """(n, n) two-view overlap in [0, 1], symmetric, 1 on the diagonal."""

    def __len__(self) -> int:
        return len(self.names)

    def three_view(self, a: int, b: int, c: int) -> float:
        """Return the three-view overlap of a triplet in [0, 1]."""
        return max(self._ratio(a, b, c), self._ratio(b, a, c), self._ratio(c, a, b))

    def _ratio(self, view: int, first: int, second: int) -> float:
        """Compute the ratio of a view's pixels (or points) that are visible in two other views."""
        both = self.seen[view][first] & self.seen[view][second]
        return float(_ONES[both].sum(dtype=np.int64)) / max(float(self.counts[view]), 1.0)


def overlap_from_depth(
    names: Sequence[str],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, PinholeCamera],
    depth_of: Callable[[str], Float32],
) -> Overlap:
    """Compute the overlap of views with true depth.

    Args:
        names: Names of the n views.
        poses: ``cam_from_world`` by name.
        cameras: Intrinsics by name.
        depth_of: Function that returns the depth (h, w) of an image name in the unit of the poses,
            0 where unknown.
    """
    views = [_downsample(cameras[name], depth_of(name)) for name in names]
    seen, counts = [], np.array([float((depth > 0).sum()) for _, depth in views])
    for i, name in enumerate(names):
        camera, depth = views[i]
        known = depth > 0
        points = unproject(camera, pixel_centers(*camera.size)[known], depth[known])
        rotation, translation = poses[name]
        world = (points - translation) @ rotation
        rows = [_sees(*views[j], poses[other], world) for j, other in enumerate(names)]
        seen.append(np.packbits(np.stack(rows), axis=1))
    return _build_overlap(names, seen, counts)


def overlap_from_model(model: pycolmap.Reconstruction, names: Sequence[str]) -> Overlap:
    """Compute the overlap of images of a COLMAP model from their observed points."""
    by_name = {str(image.name): image for image in model.images.values()}
    observed = [
        np.unique([p.point3D_id for p in by_name[n].get_observation_points2D()]).astype(np.uint64)
        for n in names
    ]
    seen = []
    for points in observed:
        rows = [np.isin(points, others, assume_unique=True) for others in observed]
        seen.append(np.packbits(np.stack(rows), axis=1))
    return _build_overlap(names, seen, np.array([float(len(points)) for points in observed]))


def _build_overlap(names: Sequence[str], seen: Sequence[UInt8], counts: Float64) -> Overlap:
    """Compute the (n, n) two-view overlap from packed visibility bits."""
    shared = np.stack([_ONES[bits].sum(axis=1, dtype=np.int64) for bits in seen])
    one_way = shared / np.maximum(counts, 1.0)[:, None]
    two_view = np.minimum(one_way, one_way.T)
    np.fill_diagonal(two_view, 1.0)
    return Overlap(tuple(names), tuple(seen), counts, two_view)


def _downsample(camera: PinholeCamera, depth: Float32) -> tuple[PinholeCamera, Float32]:
    """Resize camera and depth map to the comparison grid with nearest-neighbor sampling."""
    rows = max(1, round(_GRID_COLUMNS * camera.height / camera.width))
    return camera.resized(_GRID_COLUMNS, rows), resize_map(depth, _GRID_COLUMNS, rows, linear=False)


def _sees(camera: PinholeCamera, depth: Float32, pose: Pose, world: Float64) -> Bool:
    """Return the mask (n,) of world points (n, 3) that agree with the depth map of a view."""
    local = transform(*pose, world)
    xy = project(camera, local)
    within = inside(xy, camera.size)
    view_depth = sample_nearest(depth, np.where(within[:, None], xy, 0.0))
    consistent = np.abs(view_depth - local[:, 2]) <= DEPTH_TOLERANCE * local[:, 2]
    return np.asarray(within & (view_depth > 0) & consistent)
