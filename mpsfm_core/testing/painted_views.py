"""Views that carry their depth and normals in their colours.

What a plugin does wrong, it does around its network: it swaps channels, shifts by half a pixel,
forgets the focal length, returns a std for a variance. To see that, somebody has to know the right
answer. So the contract kit paints it into the view, and a stand-in for the network only has to
read colours: one affine map of the three channels, or a 1 x 1 convolution. Everything else that
the plugin does stays as it is.

The code, for values of 0 to 255:

* red is depth, 0 to :data:`MAX_DEPTH` metres; 0 means that there is no surface;
* green and blue are the slopes ``p = n_x / -n_z`` and ``q = n_y / -n_z`` of the normal, from
  ``-MAX_SLOPE`` to ``MAX_SLOPE``: the normal is ``(p, q, -1)``, made unit.

A stand-in that gives an uncertainty says :data:`RELATIVE_STD` of the depth and
:data:`NORMALS_STD`, everywhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float64, UInt8

MAX_DEPTH = 10.0
"""Metres; a step of one of 255 is 4 cm."""
MAX_SLOPE = 4.0
"""Of surfaces seen at up to 76 degrees from their normal; a step is 1.8 degrees at most."""
RELATIVE_STD = 0.05
"""Std of depth as a share of it, that a stand-in or a told provider reports."""
NORMALS_STD = 0.1
"""Std of normals in rad, likewise."""

_HALF = 127.5


def paint(depth: NDArray[Any], normals: NDArray[Any], valid: Bool) -> UInt8:
    """The colours (h, w, 3) of depth (h, w) in metres and normals (h, w, 3) that face the camera.

    Depth beyond :data:`MAX_DEPTH` and slopes beyond :data:`MAX_SLOPE` are cut.
    """
    toward = np.where(valid, np.maximum(-normals[..., 2], 1e-6), 1.0)
    slopes = np.where(valid[..., None], normals[..., :2], 0.0) / toward[..., None]
    red = np.where(valid, depth, 0.0) / MAX_DEPTH * 2 - 1
    coded = np.concatenate([red[..., None], slopes / MAX_SLOPE], axis=-1)
    colours: UInt8 = np.round(_HALF + _HALF * np.clip(coded, -1, 1)).astype(np.uint8)
    return colours


def decoder() -> tuple[Float64, Float64]:
    """Weights (4, 3) and bias (4,) of the layer that reads a painted pixel.

    ``weights @ rgb + bias`` for values of 0 to 255 is ``(depth, p, q, -1)``: the depth in metres,
    and a normal that has yet to be made unit.
    """
    step = MAX_SLOPE / _HALF
    weights = np.zeros((4, 3))
    weights[0, 0], weights[1, 1], weights[2, 2] = MAX_DEPTH / 255, step, step
    return weights, np.array([0.0, -MAX_SLOPE, -MAX_SLOPE, -1.0])


def read_depth(rgb: NDArray[Any]) -> Float64:
    """Depth in metres (...) of painted colours (..., 3), 0 where there is no surface."""
    weights, bias = decoder()
    depth: Float64 = rgb.astype(np.float64) @ weights[0] + bias[0]
    return depth


def read_normals(rgb: NDArray[Any]) -> Float64:
    """Normals (..., 3), not unit, of painted colours (..., 3)."""
    weights, bias = decoder()
    normals: Float64 = rgb.astype(np.float64) @ weights[1:].T + bias[1:]
    return normals
