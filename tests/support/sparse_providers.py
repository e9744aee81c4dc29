"""Detector and matcher without options, as base classes of providers in tests of the contract kit.

They import OpenCV and pycolmap, other than :mod:`tests.support.reference_providers`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mpsfm_core import DenseMatches, PairMatches, View
from mpsfm_core.data import Float64
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.mutual_nearest import MutualNearest
from mpsfm_core.providers.builtin.options import MutualNearestOptions, SiftOptions
from mpsfm_core.providers.builtin.sift import Sift


class SiftDetector(Sift):
    """SIFT with the options of the class."""

    sift_options = SiftOptions()

    def __init__(self, options: object, context: ProviderContext) -> None:
        super().__init__(self.sift_options, context)


class NearestMatcher(MutualNearest):
    """Mutual nearest neighbors with default options."""

    def __init__(self, options: object, context: ProviderContext) -> None:
        super().__init__(MutualNearestOptions(), context)


class DenseSift(NearestMatcher):
    """Dense matcher that returns the positions of matched SIFT features."""

    std_px = 1.0

    def __init__(self, options: object, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.detector = SiftDetector(options, context)

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        features = self.detector.extract(a), self.detector.extract(b)
        sparse = super().match(a, b, *features).sparse
        assert sparse is not None
        points = [
            np.clip(self.move(f.keypoints[sparse.indices[:, i]]), 0, view.camera.size)
            for i, (f, view) in enumerate(zip(features, (a, b), strict=True))
        ]
        return PairMatches(dense=DenseMatches(*points, sparse.scores, self.std_px))

    def move(self, xy: Float64) -> Float64:
        """Change the positions (n, 2) of matches in one view."""
        return xy


class CellMatcher(DenseSift):
    """Dense matcher that rounds positions to the centers of cells of 4 pixels."""

    std_px = 2.0
    offset_px = 2.0
    """Position of the rounded matches in a cell."""

    def move(self, xy: Float64) -> Float64:
        return np.floor(xy / 4) * 4 + self.offset_px
