"""Subsampling of depth maps, normal maps and cameras, and bilinear upsampling."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, NormalPrior, PinholeCamera

Scalar = TypeVar("Scalar", bound=np.generic)
Prior = TypeVar("Prior", DepthPrior, NormalPrior)


def compute_subsampling_step(num_columns: int, max_columns: int) -> int:
    """Return the subsampling step that reduces ``num_columns`` to about ``max_columns``."""
    return max(1, round(num_columns / max_columns))


def subsample(values: NDArray[Scalar], step: int) -> NDArray[Scalar]:
    """Return every ``step``-th row and column of a map (h, w, ...), starting at ``step // 2``."""
    # Compiled kernels require contiguous arrays.
    return np.ascontiguousarray(values[step // 2 :: step, step // 2 :: step])


def subsample_prior(prior: Prior, step: int) -> Prior:
    """Subsample a depth or normal prior, or return the prior itself if the step is 1."""
    if step == 1:
        return prior
    maps: dict[str, Any] = {
        field.name: subsample(value, step)
        for field in fields(prior)
        if isinstance(value := getattr(prior, field.name), np.ndarray)
    }
    return replace(prior, **maps)


def subsample_camera(camera: PinholeCamera, step: int) -> PinholeCamera:
    """Return the pinhole camera of a subsampled depth map."""
    columns, rows = (len(range(step // 2, size, step)) for size in camera.size)
    fx, fy, cx, cy = camera.params
    offset = _offset(step)
    return PinholeCamera(
        columns, rows, fx / step, fy / step, cx / step - offset, cy / step - offset
    )


def subsample_pixels(xy: Float64, step: int) -> Float64:
    """Convert pixels (n, 2) of a map to pixels of the subsampled map."""
    pixels: Float64 = xy / step - _offset(step)
    return pixels


def upsample(values: Float64, valid: Bool, shape: tuple[int, int]) -> Float32:
    """Upsample a subsampled map bilinearly to its original size (h, w).

    Invalid pixels have no weight in the interpolation. The upsampled map is 0 at pixels without a
    valid neighbor.
    """
    rows, columns = shape
    step = compute_subsampling_step(columns, values.shape[1])
    known = np.stack([np.where(valid, values, 0), valid], axis=-1).astype(np.float32)
    known = _stretched(_stretched(known, rows, step).swapaxes(0, 1), columns, step)
    total, share = np.moveaxis(known.swapaxes(0, 1), -1, 0)
    return np.where(share > 1e-3, total / np.maximum(share, 1e-3), 0).astype(np.float32)


def _stretched(values: Float32, size: int, step: int) -> Float32:
    """Interpolate an array linearly along its first axis, with constant extrapolation."""
    at = (np.arange(size) + 0.5) / step - _offset(step) - 0.5
    at = np.clip(at, 0, len(values) - 1)
    low = np.minimum(at.astype(np.int64), max(len(values) - 2, 0))
    share = (at - low).astype(np.float32).reshape(-1, *[1] * (values.ndim - 1))
    high = np.minimum(low + 1, len(values) - 1)
    stretched: Float32 = (1 - share) * values[low] + share * values[high]
    return stretched


def _offset(step: int) -> float:
    """Return the offset between pixel coordinates of full and subsampled map."""
    return (step // 2 + 0.5) / step - 0.5
