"""Projection and unprojection of a pinhole camera, and sampling of maps.

All projection functions accept arrays with any number of leading axes. Pixels follow COLMAP: the
center of the first pixel is (0.5, 0.5), so ``map[row, col]`` is the value at ``(col + 0.5, row +
0.5)``. Resizing a W x H view to w x h maps ``x`` to ``x * w / W`` exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float32, Float64, PinholeCamera


def pixel_centers(width: int, height: int) -> Float64:
    """Return the centers (height, width, 2) of all pixels of a map in COLMAP pixels."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], axis=-1)


def rays(camera: PinholeCamera, xy: Float64) -> Float64:
    """Return the rays (..., 3) with z = 1 through pixels (..., 2) in the camera frame."""
    x = (xy[..., 0] - camera.cx) / camera.fx
    y = (xy[..., 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def unproject(camera: PinholeCamera, xy: Float64, depth: NDArray[Any]) -> Float64:
    """Unproject pixels (..., 2) with z-depth (...) to points (..., 3) in the camera frame."""
    return rays(camera, xy) * np.asarray(depth, dtype=np.float64)[..., None]


def project(camera: PinholeCamera, points: Float64) -> Float64:
    """Project points (..., 3) in the camera frame to pixels (..., 2).

    The pixel of a point with z <= 0 is NaN.
    """
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    x = camera.fx * points[..., 0] / z + camera.cx
    y = camera.fy * points[..., 1] / z + camera.cy
    return np.stack([x, y], axis=-1)


def scale_pixels(xy: Float64, from_size: tuple[int, int], to_size: tuple[int, int]) -> Float64:
    """Convert pixels (..., 2) of a view of size (W, H) to pixels of a map of size (w, h)."""
    return xy * (np.array(to_size, dtype=np.float64) / np.array(from_size, dtype=np.float64))


def inside(xy: Float64, size: tuple[int, int]) -> Bool:
    """Return whether pixels (..., 2) are inside a view of size (width, height), False for NaN."""
    x, y = xy[..., 0], xy[..., 1]
    with np.errstate(invalid="ignore"):
        result: Bool = (x >= 0) & (y >= 0) & (x <= size[0]) & (y <= size[1])
    return result


def sample_nearest(values: NDArray[Any], xy: Float64) -> NDArray[Any]:
    """Sample a map at the nearest pixels of positions (n, 2), clamped to the border."""
    col = np.clip(np.floor(xy[:, 0]).astype(np.int64), 0, values.shape[1] - 1)
    row = np.clip(np.floor(xy[:, 1]).astype(np.int64), 0, values.shape[0] - 1)
    return values[row, col]


def sample_bilinear(values: NDArray[Any], valid: Bool, xy: Float64) -> tuple[Float64, Bool]:
    """Sample a map bilinearly; positions in the outer half pixel use the border's values.

    Args:
        values: (h, w) map.
        valid: (h, w) mask.
        xy: (n, 2) sample positions in COLMAP pixels of the map.

    Returns:
        Samples (n,) float64, and a mask (n,) that is True if all interpolated pixels are valid.
    """
    height, width = values.shape
    x = np.clip(np.nan_to_num(xy[:, 0]) - 0.5, 0, width - 1)
    y = np.clip(np.nan_to_num(xy[:, 1]) - 0.5, 0, height - 1)
    x0 = np.minimum(x.astype(np.int64), max(width - 2, 0))
    y0 = np.minimum(y.astype(np.int64), max(height - 2, 0))
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    ax, ay = x - x0, y - y0
    samples = np.zeros(len(xy))
    ok = inside(xy, (width, height))
    for col, row, weight in (
        (x0, y0, (1 - ax) * (1 - ay)),
        (x1, y0, ax * (1 - ay)),
        (x0, y1, (1 - ax) * ay),
        (x1, y1, ax * ay),
    ):
        samples += np.where(weight > 0, weight * values[row, col], 0.0)
        ok &= (weight <= 0) | valid[row, col]
    return samples, ok


def resize_map(values: NDArray[Any], width: int, height: int, *, linear: bool = True) -> Float32:
    """Resize a map to another number of rows and columns.

    Args:
        values: (h, w) or (h, w, c) map, for example of depth or normals.
        width: Number of columns of the resized map.
        height: Number of rows of the resized map.
        linear: If True, average areas to shrink and interpolate bilinearly to enlarge; if False,
            use the nearest pixel.

    Returns:
        Resized map, (height, width) or (height, width, c) float32.
    """
    import cv2  # The import is local, because OpenCV slows down the start of the command line.

    values = np.ascontiguousarray(values, dtype=np.float32)
    if values.shape[:2] == (height, width):
        return values
    shrinks = width < values.shape[1] and height < values.shape[0]
    mode = (cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR) if linear else cv2.INTER_NEAREST_EXACT
    resized: Float32 = cv2.resize(values, (width, height), interpolation=mode)
    return resized


def log_depth_steps(depth: Float32, valid: Bool) -> Float32:
    """Compute the maximum difference of log depth to the four neighboring pixels.

    Args:
        depth: (h, w) depth.
        valid: (h, w) mask of valid pixels; differences to invalid pixels are ignored.

    Returns:
        (h, w) float32 maximum difference of log depth, >= 0; 0.1 is about 10 % of depth.
    """
    steps = np.zeros(depth.shape, dtype=np.float32)
    log_depth = np.log(np.where(valid, depth, np.float32(1)))
    for axis in (0, 1):
        values, ok = np.moveaxis(log_depth, axis, 0), np.moveaxis(valid, axis, 0)
        step = np.where(ok[1:] & ok[:-1], np.abs(np.diff(values, axis=0)), np.float32(0))
        along = np.moveaxis(steps, axis, 0)
        np.maximum(along[1:], step, out=along[1:])
        np.maximum(along[:-1], step, out=along[:-1])
    return steps
