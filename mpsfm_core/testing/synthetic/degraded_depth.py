"""Depth as a good monocular network predicts it, made from true depth: smooth, seeded errors.

Errors of networks are no pixel noise. A map as a whole has a wrong scale, and what remains bends
and shifts whole surfaces. Both are imitated here; the errors of an image depend on its name and
the seed only, so that every test and benchmark that asks for them sees the same.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.geometry import resize_map

_GRID = 120
"""Columns of the grid on which the field is drawn; the shorter length is 4 of them."""


@dataclass(frozen=True)
class DepthErrors:
    """A model of relative errors: ``depth * exp(scale * n + field * f(x, y))``.

    ``scale``: std of the error that an image has as a whole; not part of :attr:`std`, as the scale
    of each image is free in the mapper (s_i in the paper). ``field``: std of the field ``f``, a
    sum of two blurred Gaussian noises. ``lengths``: stds of the blur, as shares of the map's
    width. ``weights``: of the two, their squares sum to one.
    """

    scale: float = 0.05
    field: float = 0.05
    lengths: tuple[float, float] = (1 / 8, 1 / 30)
    weights: tuple[float, float] = (0.8, 0.6)

    @property
    def std(self) -> float:
        """Relative std of a pixel after its image was given the best scale: what an honest
        declaration says. The scale also takes the mean of the field along, so that errors are some
        6 % smaller than declared."""
        return self.field


def degrade_depth(
    depth: Float32, name: str, errors: DepthErrors | None = None, seed: int = 0
) -> Float32:
    """A depth map (h, w) with the errors of the image ``name``; invalid zeros stay zero."""
    errors = errors or DepthErrors()
    key = hashlib.sha256(name.encode()).digest()[:8]
    rng = np.random.default_rng([seed, int.from_bytes(key, "little")])
    height, width = depth.shape
    rows = max(2, round(_GRID * height / width))
    log_factor = errors.scale * rng.normal() * np.ones((rows, _GRID))
    for length, weight in zip(errors.lengths, errors.weights, strict=True):
        log_factor += errors.field * weight * _smooth_noise(rng, rows, length * _GRID)
    degraded: Float32 = depth * np.exp(resize_map(log_factor, width, height))
    return degraded


def _smooth_noise(rng: np.random.Generator, rows: int, blur: float) -> Float64:
    """Blurred Gaussian noise of std 1; drawn wider than needed, as blurring sees no border so."""
    margin = math.ceil(3 * blur)
    noise = rng.normal(size=(rows + 2 * margin, _GRID + 2 * margin))
    blurred = cv2.GaussianBlur(noise, (0, 0), blur)[margin:-margin, margin:-margin]
    # Neighbours average to this std; the sample's own would hide errors longer than the map.
    return np.asarray(blurred * (2 * blur * math.sqrt(math.pi)))
