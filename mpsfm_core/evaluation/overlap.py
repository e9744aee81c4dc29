"""How much views see of each other, from true depth or from a COLMAP model.

Two-view overlap: share of what one view sees that the other sees too, the minimum of both
directions. Three-view overlap of a triplet: share of what one of its views sees that both others
see, the largest over its views. What a view sees is counted in pixels with known depth, where
there is depth (seen in another view: projects into it, and the depth there agrees within 5 %), else
in the points of the model that it observes (paper, low-overlap evaluation).
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
"""Relative difference of depth up to which two views see the same surface."""
_GRID = 96
"""Columns of the grid on which pixels are compared."""
_ONES: UInt8 = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(
    axis=1, dtype=np.uint8
)


@dataclass(frozen=True, eq=False)
class Overlap:
    """What views see of each other.

    ``seen``: for each view i (n, bytes) uint8, row j: which of the units that i sees (pixels or
    points) view j sees as well, as bits. ``counts``: (n,) how many units each view sees.
    ``two_view``: (n, n) float64 in [0, 1], symmetric, 1 on the diagonal.
    """

    names: tuple[str, ...]
    seen: tuple[UInt8, ...]
    counts: Float64
    two_view: Float64

    def __len__(self) -> int:
        return len(self.names)

    def three_view(self, a: int, b: int, c: int) -> float:
        """Three-view overlap of a triplet, in [0, 1]."""
        return max(self._share(a, b, c), self._share(b, a, c), self._share(c, a, b))

    def _share(self, view: int, first: int, second: int) -> float:
        """Share of what a view sees that both others see."""
        both = self.seen[view][first] & self.seen[view][second]
        return float(_ONES[both].sum(dtype=np.int64)) / max(float(self.counts[view]), 1.0)


def overlap_from_depth(
    names: Sequence[str],
    poses: Mapping[str, Pose],
    cameras: Mapping[str, PinholeCamera],
    depth_of: Callable[[str], Float32],
) -> Overlap:
    """Overlap of views with true depth (h, w) in the unit of the poses, 0 where unknown."""
    views = [_reduced(cameras[name], depth_of(name)) for name in names]
    seen, counts = [], np.array([float((depth > 0).sum()) for _, depth in views])
    for i, name in enumerate(names):
        camera, depth = views[i]
        known = depth > 0
        points = unproject(camera, pixel_centers(*camera.size)[known], depth[known])
        rotation, translation = poses[name]
        world = (points - translation) @ rotation
        rows = [_sees(*views[j], poses[other], world) for j, other in enumerate(names)]
        seen.append(np.packbits(np.stack(rows), axis=1))
    return _overlap(names, seen, counts)


def overlap_from_model(model: pycolmap.Reconstruction, names: Sequence[str]) -> Overlap:
    """Overlap of images of a COLMAP model by the points they observe."""
    by_name = {str(image.name): image for image in model.images.values()}
    observed = [
        np.unique([p.point3D_id for p in by_name[n].get_observation_points2D()]).astype(np.uint64)
        for n in names
    ]
    seen = []
    for points in observed:
        rows = [np.isin(points, others, assume_unique=True) for others in observed]
        seen.append(np.packbits(np.stack(rows), axis=1))
    return _overlap(names, seen, np.array([float(len(points)) for points in observed]))


def _overlap(names: Sequence[str], seen: Sequence[UInt8], counts: Float64) -> Overlap:
    shared = np.stack([_ONES[bits].sum(axis=1, dtype=np.int64) for bits in seen])
    one_way = shared / np.maximum(counts, 1.0)[:, None]
    two_view = np.minimum(one_way, one_way.T)
    np.fill_diagonal(two_view, 1.0)
    return Overlap(tuple(names), tuple(seen), counts, two_view)


def _reduced(camera: PinholeCamera, depth: Float32) -> tuple[PinholeCamera, Float32]:
    """Camera and depth on the grid of comparison; no depth is made up between two surfaces."""
    rows = max(1, round(_GRID * camera.height / camera.width))
    return camera.resized(_GRID, rows), resize_map(depth, _GRID, rows, linear=False)


def _sees(camera: PinholeCamera, depth: Float32, pose: Pose, world: Float64) -> Bool:
    """Which world points (n, 3) a view sees."""
    local = transform(*pose, world)
    xy = project(camera, local)
    within = inside(xy, camera.size)
    there = sample_nearest(depth, np.where(within[:, None], xy, 0.0))
    agrees = np.abs(there - local[:, 2]) <= DEPTH_TOLERANCE * local[:, 2]
    return np.asarray(within & (there > 0) & agrees)
