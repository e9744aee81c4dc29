"""Rule-based sky mask from smooth, bright or blue regions at the upper image border."""

from __future__ import annotations

import cv2
import numpy as np

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool, Float32, UInt8
from mpsfm_core.geometry import resize_map
from mpsfm_sky.options import SimpleSkyOptions

_LONGER_SIDE = 256
_CLEARANCE = 3
"""Kernel size in pixels of the erosion that separates sky from adjacent regions."""


class SimpleSky:
    """Provider of a mask of sky-like regions at the upper image border, even white walls."""

    def __init__(self, options: SimpleSkyOptions, context: ProviderContext) -> None:
        self._options = options

    def mask(self, view: View) -> Bool:
        """Compute a mask of the image size that is False on sky."""
        factor = min(1.0, _LONGER_SIDE / max(view.camera.size))
        width, height = (max(1, round(side * factor)) for side in view.camera.size)
        likely = self._likely(resize_map(view.image, width, height))
        kernel = np.ones((_CLEARANCE, _CLEARANCE), dtype=np.uint8)
        parted = cv2.erode(likely, kernel, borderType=cv2.BORDER_REPLICATE)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(parted, connectivity=4)
        large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= self._options.min_share * labels.size)
        above = np.intersect1d(large[large > 0], labels[0])
        core = np.isin(labels, above).astype(np.uint8)
        inner = cv2.dilate(core, kernel, iterations=2) & likely
        sky = cv2.dilate(inner, kernel)  # adds the skyline, where brightness changes
        keep: Bool = resize_map(sky, *view.camera.size) <= 0.5
        return keep

    def _likely(self, rgb: Float32) -> UInt8:
        """Compute an image (h, w) that is 1 where an RGB image (0..255) may show sky."""
        options = self._options
        red, _, blue = np.moveaxis(rgb / 255, -1, 0)
        gray = rgb.mean(axis=-1) / 255
        steps = np.maximum(
            np.abs(np.gradient(gray, axis=0)) if len(gray) > 1 else 0 * gray,
            np.abs(np.gradient(gray, axis=1)) if gray.shape[1] > 1 else 0 * gray,
        )
        bright = (gray >= options.brightness) & (red - blue <= options.warmth)
        likely = (bright | (blue - red >= options.blueness)) & (steps <= options.roughness)
        return np.asarray(likely, dtype=np.uint8)
