"""Synthetic monocular depth: true depth with smooth, seeded errors.

The errors of depth networks are not independent between pixels. The predicted depth map has a wrong
scale, and smooth errors bend and shift whole surfaces. This module simulates a scale error of the
whole map and smooth errors of its surfaces. The errors of an image depend only on its name and the
seed, so that all tests and benchmarks use the same depth errors.
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
"""Number of columns of the grid on which the two depth noise fields are drawn."""


@dataclass(frozen=True)
class DepthErrors:
    """Model of relative depth errors, ``depth * exp(scale * n + field * f(x, y))``.

    The random number ``n`` of each image is standard normal, and ``f`` is the sum of two blurred
    Gaussian noise fields.
    """

    scale: float = 0.05
    """Std of the relative depth error that a whole image shares. The property ``std`` excludes the
    scale error, because the mapper estimates a scale per image (``s_i`` in the paper)."""
    field: float = 0.05
    """Std of the noise field ``f``, which is a relative depth error."""
    lengths: tuple[float, float] = (1 / 8, 1 / 30)
    """Std of the Gaussian blur of each noise field relative to the width of the depth map."""
    weights: tuple[float, float] = (0.8, 0.6)
    """Weights of the two noise fields, whose squares sum to one."""

    @property
    def std(self) -> float:
        """Relative depth std of a pixel after the image has received its optimal scale.

        The optimal scale also removes the mean of the noise field, so the actual errors are about 6
        % smaller than the returned std.
        """
        return self.field


def degrade_depth(
    depth: Float32, name: str, errors: DepthErrors | None = None, seed: int = 0
) -> Float32:
    """Add the errors of a monocular depth network to a true depth map.

    Args:
        depth: True z-depth (h, w). Pixels with zero depth are invalid and remain zero.
        name: Name of the image, which seeds the errors.
        errors: Model of the errors, by default :class:`DepthErrors`.
        seed: Number that seeds the errors in addition to the image name.

    Returns:
        z-depth (h, w) with simulated errors.
    """
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
    """Return blurred Gaussian noise of std 1.

    The noise is generated with a margin around the map, so that blurring has no border effect.
    """
    margin = math.ceil(3 * blur)
    noise = rng.normal(size=(rows + 2 * margin, _GRID + 2 * margin))
    blurred = cv2.GaussianBlur(noise, (0, 0), blur)[margin:-margin, margin:-margin]
    # The theoretical std of blurred white noise normalizes the noise, because dividing by the
    # sample std would remove errors longer than the map.
    return np.asarray(blurred * (2 * blur * math.sqrt(math.pi)))
