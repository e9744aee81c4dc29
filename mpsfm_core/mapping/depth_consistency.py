"""Dense depth consistency check between views (paper section 3.4).

The refined map of one image is carried into another through a nearest-depth buffer. Where it
lands clearly in front of the surface that the other image sees, the two contradict each other:
something would have to float in space that was seen to be empty. Behind is an occlusion.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.scene.scene import Scene

WARP_NOISE_PX = 1.0
"""Std of a pixel's position in the lift (reference: 1 px)."""


class Inconsistency(NamedTuple):
    """Share of contradicting pixels in both directions, and how many pixels were compared."""

    outgoing: float
    incoming: float
    compared: int

    @property
    def score(self) -> float:
        """The worse direction."""
        return max(self.outgoing, self.incoming)


def check_image(
    scene: Scene, image: int, neighbors: list[int], options: ConsistencyOptions
) -> Inconsistency:
    """How much the depth of an image contradicts that of its neighbours, pooled over them."""
    outgoing = np.sum([_compare(scene, image, n, options) for n in neighbors], axis=0)
    incoming = np.sum([_compare(scene, n, image, options) for n in neighbors], axis=0)
    shares = [
        float(violations / total) if (total := violations + surface) >= options.min_pixels else 0.0
        for violations, surface in (outgoing, incoming)
    ]
    return Inconsistency(shares[0], shares[1], int(np.sum([outgoing, incoming])))


def _compare(
    scene: Scene, source: int, target: int, options: ConsistencyOptions
) -> tuple[int, int]:
    """Pixels of ``target`` that ``source`` contradicts, and those it confirms."""
    a, b = scene.maps[source], scene.maps[target]
    rotation = scene.rotations[target] @ scene.rotations[source].T
    translation = scene.translations[target] - rotation @ scene.translations[source]
    depth, variance = warp_depth(
        a.depth,
        a.variance,
        a.valid,
        a.camera.params,
        rotation,
        translation,
        b.camera.params,
        b.depth.shape,
    )
    seen = np.isfinite(depth) & b.valid
    deviation = (depth[seen] - b.depth[seen]) / np.sqrt(variance[seen] + b.variance[seen])
    violations = deviation < -options.max_deviation
    surface = np.abs(deviation) <= options.max_deviation
    return int(violations.sum()), int(surface.sum())


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def warp_depth(
    depth: Float32,
    variance: Float32,
    valid: Bool,
    params: Float64,
    rotation: Float64,
    translation: Float64,
    target_params: Float64,
    target_shape: tuple[int, int],
) -> tuple[Float64, Float64]:
    """Carry a depth map into another view, keeping the nearest surface per pixel.

    Args:
        depth, variance, valid: (h, w) maps of the source. params: its (fx, fy, cx, cy) on the
            grid. rotation, translation: ``target_from_source``. target_params, target_shape: the
            target's grid.

    Returns:
        Depth (inf where nothing lands) and variance of the carried depth, target shape, float64.
        The variance propagates that of the source's depth and of the pixel's position.
    """
    rows, columns = target_shape
    buffer = np.full((rows, columns), np.inf)
    spread = np.zeros((rows, columns))
    r, t = rotation, translation
    for row in range(depth.shape[0]):
        y = (row + 0.5 - params[3]) / params[1]
        for column in range(depth.shape[1]):
            if not valid[row, column]:
                continue
            d = float(depth[row, column])
            x = (column + 0.5 - params[2]) / params[0]
            slope = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            z = d * slope + t[2]
            if z <= 1e-9:
                continue
            u = (d * (r[0, 0] * x + r[0, 1] * y + r[0, 2]) + t[0]) / z
            v = (d * (r[1, 0] * x + r[1, 1] * y + r[1, 2]) + t[1]) / z
            u = u * target_params[0] + target_params[2]
            v = v * target_params[1] + target_params[3]
            if not (0 <= u < columns and 0 <= v < rows):
                continue
            i, j = int(v), int(u)
            if z < buffer[i, j]:
                buffer[i, j] = z
                across = (r[2, 0] / params[0]) ** 2 + (r[2, 1] / params[1]) ** 2
                noise = WARP_NOISE_PX**2 * d * d * across
                spread[i, j] = slope * slope * variance[row, column] + noise
    return buffer, spread
