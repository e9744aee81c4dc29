from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core import DepthPrior, Options, ProviderContext, View

Array = NDArray[Any]
COLUMNS, ROWS = 80, 60
SCALES = (2, 8)


class RidgeDepthOptions(Options):
    weights: str = "package:ridge_depth/room.npz"
    sha256: str | None = None


class RidgeDepth:
    def __init__(self, options: RidgeDepthOptions, context: ProviderContext) -> None:
        with np.load(context.resolve_weights(options.weights, options.sha256)) as stored:
            self._regression = Regression(**stored)

    def predict(self, view: View) -> DepthPrior:
        depth = self._regression(features(view.image))  # z-depth in meters, 80 x 60 pixels
        return DepthPrior.from_arrays(depth)


class Regression:
    """Ridge regression of depth, linear in image features and in random cosines of them."""

    def __init__(
        self, mean: Array, scale: Array, directions: Array, phases: Array, weights: Array
    ) -> None:
        self._scaling, self._cosines, self._weights = (mean, scale), (directions, phases), weights

    def __call__(self, x: Array) -> Array:
        depth: Array = self.expand(x) @ self._weights
        return depth

    def expand(self, x: Array) -> Array:
        (mean, scale), (directions, phases) = self._scaling, self._cosines
        cosines = np.cos((x - mean) / scale @ directions + phases)
        return np.concatenate([x, np.ones_like(x[..., :1]), cosines], axis=-1)


def features(rgb: Array) -> Array:
    """Compute features (60, 80, 13): color, position, and contrast of two neighborhoods."""
    small = cv2.resize(rgb, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA) / np.float32(255)
    place = np.meshgrid(np.linspace(-1, 1, COLUMNS), np.linspace(-1, 1, ROWS))
    planes = [small, *(axis[..., None] for axis in place)]
    for scale in SCALES:
        blurred = cv2.GaussianBlur(small, (0, 0), scale)
        planes += [blurred, cv2.GaussianBlur(abs(small - blurred), (0, 0), scale)[..., :1]]
    return np.concatenate(planes, axis=-1, dtype=np.float32)
