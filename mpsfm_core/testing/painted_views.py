"""Synthetic views whose colors encode their depth and normals.

Most mistakes of a plugin are in the code around its network: swapped channels, a half-pixel shift,
an ignored focal length, a std instead of a variance. Detecting mistakes of a plugin requires ground
truth. The contract tests therefore encode true depth and normals in the colors of the test images.
A tiny test network replaces the real network and only decodes colors, with an affine map of the
three channels or a 1 x 1 convolution. The contract tests use all code of the plugin except the real
network.

The color channels with values from 0 to 255 encode the ground truth.

* The red channel is depth from 0 to :data:`MAX_DEPTH` meters, where 0 means no surface.
* The green and blue channels are the slopes ``p = n_x / -n_z`` and ``q = n_y / -n_z`` of the normal
  ``(p, q, -1)``, from ``-MAX_SLOPE`` to ``MAX_SLOPE``.

A test network that predicts uncertainty reports the std :data:`RELATIVE_STD` or :data:`NORMALS_STD`
at every pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float64, UInt8

MAX_DEPTH = 10.0
"""Largest depth in meters that a color encodes; one of 255 color steps is 4 cm."""
MAX_SLOPE = 4.0
"""Largest slope that a color encodes, of a surface seen at 76 degrees from its normal; one color
step is at most 1.8 degrees."""
RELATIVE_STD = 0.05
"""Relative std of depth that small test networks and prepared depth files report."""
NORMALS_STD = 0.1
"""Std of normals in rad that small test networks and prepared normal files report."""

_HALF = 127.5
_ZERO = 128
_DECODES_NORMALS: ContextVar[bool] = ContextVar("colors encode x, y and z", default=False)
_UNIT_M: ContextVar[float] = ContextVar("unit of decoded depth in meters", default=1.0)


@contextmanager
def depth_unit(meters: float) -> Iterator[None]:
    """Multiply the depth that colors encode by ``meters`` in a ``with`` block.

    A test network whose weights :func:`decoder` returns in the block sees a scene that is larger by
    the factor ``meters``, although the colors of the views are the same.
    """
    token = _UNIT_M.set(meters)
    try:
        yield
    finally:
        _UNIT_M.reset(token)


@contextmanager
def normal_colors() -> Iterator[None]:
    """Encode x, y and z of normals as colors in a ``with`` block, instead of depth and slopes.

    A test network whose weights :func:`decoder` returns in the block decodes normals of any
    direction from the images of :func:`paint_normals`.
    """
    token = _DECODES_NORMALS.set(True)
    try:
        yield
    finally:
        _DECODES_NORMALS.reset(token)


def paint_normals(normals: NDArray[Any]) -> UInt8:
    """Encode unit normals (h, w, 3) as RGB colors (h, w, 3), zero as 128."""
    colors: UInt8 = np.round(_ZERO + _HALF * normals).clip(0, 255).astype(np.uint8)
    return colors


def paint(depth: NDArray[Any], normals: NDArray[Any], valid: Bool) -> UInt8:
    """Encode depth and normals as the colors of a synthetic view.

    Args:
        depth: z-depth (h, w) in meters, clipped at :data:`MAX_DEPTH`.
        normals: Unit normals (h, w, 3) that face the camera; slopes are clipped at
            :data:`MAX_SLOPE`.
        valid: Validity mask (h, w), True where the pixel shows a surface.

    Returns:
        RGB image (h, w, 3) whose colors encode the given depth and normals.
    """
    toward = np.where(valid, np.maximum(-normals[..., 2], 1e-6), 1.0)
    slopes = np.where(valid[..., None], normals[..., :2], 0.0) / toward[..., None]
    red = np.where(valid, depth, 0.0) / MAX_DEPTH * 2 - 1
    coded = np.concatenate([red[..., None], slopes / MAX_SLOPE], axis=-1)
    colors: UInt8 = np.round(_HALF + _HALF * np.clip(coded, -1, 1)).astype(np.uint8)
    return colors


def decoder() -> tuple[Float64, Float64]:
    """Return weights and bias of the affine layer that decodes depth and normal from a color.

    Returns:
        Weights (4, 3) and bias (4,) of the affine decoder. The product ``weights @ rgb + bias`` for
        RGB from 0 to 255 is ``(depth, p, q, -1)``: depth in meters and a normal that is not
        normalized.
    """
    step = MAX_SLOPE / _HALF
    weights = np.zeros((4, 3))
    if _DECODES_NORMALS.get():
        weights[1:] = np.eye(3) / _HALF
        return weights, np.array([1.0, *np.full(3, -_ZERO / _HALF)])
    weights[0, 0], weights[1, 1], weights[2, 2] = _UNIT_M.get() * MAX_DEPTH / 255, step, step
    return weights, np.array([0.0, -MAX_SLOPE, -MAX_SLOPE, -1.0])


def read_depth(rgb: NDArray[Any]) -> Float64:
    """Decode depth (...) in meters, 0 without a surface, from the RGB colors (..., 3) of a view."""
    weights, bias = decoder()
    depth: Float64 = rgb.astype(np.float64) @ weights[0] + bias[0]
    return depth


def read_normals(rgb: NDArray[Any]) -> Float64:
    """Decode normals (..., 3), not normalized, from the RGB colors (..., 3) of a view."""
    weights, bias = decoder()
    normals: Float64 = rgb.astype(np.float64) @ weights[1:].T + bias[1:]
    return normals
