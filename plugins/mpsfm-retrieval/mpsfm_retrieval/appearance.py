"""Global image descriptor from SIFT features and colors, without learned weights."""

from __future__ import annotations

import cv2
import numpy as np

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Float32, Float64
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.providers.builtin.sift import Sift
from mpsfm_retrieval.options import AppearanceOptions

_SIFT_DIMENSIONS = 128
_BINS = (4, 16, 16)
"""Number of histogram bins of lightness and of both color axes of CIELAB."""


class Appearance:
    """Global descriptor from random Fourier features of SIFT descriptors and a color histogram.

    The dot product of two mean Fourier features approximates a kernel mean without a vocabulary
    (Rahimi and Recht, 2007). The kernel mean is the mean of ``exp(-sharpness |x - y|^2)`` over all
    pairs of SIFT descriptors x, y. The seed of the provider context determines the random features.
    """

    def __init__(self, options: AppearanceOptions, context: ProviderContext) -> None:
        sift = SiftOptions(
            max_keypoints=options.max_keypoints, resize=options.resize, first_octave=0
        )
        self._sift = Sift(sift, context)
        self._color_share = options.color_share
        rng = np.random.default_rng(context.seed)
        scale = np.sqrt(2 * options.sharpness)
        self._frequencies = scale * rng.normal(size=(_SIFT_DIMENSIONS, options.dimensions))
        self._phases = rng.uniform(0, 2 * np.pi, options.dimensions)

    def describe(self, view: View) -> Float32:
        """Compute a descriptor (dimensions + 1024,) of norm 1, or less than 1 without keypoints."""
        colours = np.sqrt(self._color_share) * _colours(view)
        local = np.sqrt(1 - self._color_share) * self._local(view)
        return np.concatenate([local, colours]).astype(np.float32)

    def _local(self, view: View) -> Float64:
        features = self._sift.extract(view)
        descriptors = features.descriptors
        if view.mask is not None:
            descriptors = descriptors[sample_nearest(view.mask, features.keypoints)]
        if not len(descriptors):
            return np.zeros(len(self._phases))
        return _unit(np.cos(descriptors @ self._frequencies + self._phases).mean(axis=0))


def _colours(view: View) -> Float64:
    """Compute the square root of the color histogram inside the mask, as a unit vector."""
    lab = cv2.cvtColor(view.image, cv2.COLOR_RGB2LAB)
    pixels = lab.reshape(-1, 3) if view.mask is None else lab[view.mask]
    cells = pixels.astype(np.int64) * _BINS // 256
    rows = np.ravel_multi_index(tuple(cells.T), _BINS)
    return _unit(np.sqrt(np.bincount(rows, minlength=int(np.prod(_BINS)))))


def _unit(vector: Float64) -> Float64:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
