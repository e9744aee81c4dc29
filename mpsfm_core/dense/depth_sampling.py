"""Interpolation of depth maps between pixels.

Next to surfaces at grazing angles, the depth of the nearest pixel differs from the depth of the
surface by more than the size of a voxel.
"""
# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import cv2
import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.dense.depth_edges import depth_steps
from mpsfm_core.support.jit import kernel

_MAX_DEPTH_RATIO = 1.05
"""Maximum ratio of the depths of neighboring pixels between which depth is interpolated
[tuned: benchmarks.street]."""
_SLANT_RADIUS = 3
"""Radius in pixels of the mean of inverse depth whose gradient gives the slant [ours]."""
_MIN_SLANT = 0.1
"""Minimum slant of a surface [ours]."""
_MAX_STEP = 0.02
"""Maximum relative step of inverse depth, which is 0 on planes, above which there is no slant
[tuned: benchmarks.street]."""


def compute_slant(depth: Float32, intrinsics: Float64) -> Float32:
    """Compute the distance to the surface along its normal per distance along z (h, w).

    The inverse depth of a plane is ``A r`` with the ray ``r = (x, y, 1)``, and the slant of the
    plane is ``(A r) / |A|``: 1 where the surface is perpendicular to the ray, near 0 at grazing
    angles.

    Args:
        depth: (h, w) z-depth in any unit.
        intrinsics: (4,) fx, fy, cx, cy in pixels of the depth map.
    """
    fx, fy, cx, cy = intrinsics
    side = 2 * _SLANT_RADIUS + 1
    inverse = cv2.blur(1 / np.where(depth > 0, depth, np.inf).astype(np.float32), (side, side))
    height, width = inverse.shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy)[:, None] / fy
    along_x, along_y = fx * np.gradient(inverse, axis=1), fy * np.gradient(inverse, axis=0)
    length = np.sqrt(along_x**2 + along_y**2 + (inverse - along_x * x - along_y * y) ** 2)
    slant = np.divide(inverse, length, out=np.ones_like(length), where=length > 0)
    log_depth = np.log(np.where(depth > 0, depth, 1)).astype(np.float32)
    plane = depth_steps(log_depth, _SLANT_RADIUS) < _MAX_STEP
    return np.where(plane, np.clip(slant, _MIN_SLANT, None), 1).astype(np.float32)


@kernel()
def interpolate_depth(depth: Float32, u: float, v: float) -> float:
    """Interpolate the inverse of a depth map (h, w) at pixel (u, v), which is exact on planes.

    At depth edges and holes, the depth of the nearest pixel is returned.
    """
    height, width = depth.shape
    nearest = float(depth[int(v), int(u)])
    x, y = u - 0.5, v - 0.5
    column, row = math.floor(x), math.floor(y)
    if column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return nearest
    upper_left, upper_right = depth[row, column], depth[row, column + 1]
    lower_left, lower_right = depth[row + 1, column], depth[row + 1, column + 1]
    low = min(min(upper_left, upper_right), min(lower_left, lower_right))
    high = max(max(upper_left, upper_right), max(lower_left, lower_right))
    if low <= 0 or high > _MAX_DEPTH_RATIO * low:
        return nearest
    a, b = x - column, y - row
    upper = (1 - a) / upper_left + a / upper_right
    lower = (1 - a) / lower_left + a / lower_right
    return float(1 / ((1 - b) * upper + b * lower))


@kernel()
def sample_depth(depth: Float32, xy: Float64) -> Float64:
    """Interpolate a depth map (h, w) at pixels (n, 2) inside the map."""
    samples = np.empty(len(xy))
    for k in range(len(xy)):
        samples[k] = interpolate_depth(depth, xy[k, 0], xy[k, 1])
    return samples
