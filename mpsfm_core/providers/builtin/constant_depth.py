"""Depth provider that predicts the same depth everywhere, for use without a network."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext

FLAT_GRID = (24, 32)
"""Rows and columns of the constant depth map. A depth map of one pixel would not suffice, because
normals are fitted to windows of several pixels."""


class ConstantDepth:
    """Depth provider that returns the plane z = 1 parallel to the image, without a metric unit.

    The provider's specification declares a large depth std, with which the mapper can still lift
    keypoints to 3D. A depth prior with a large std hardly influences the reconstruction of images
    with much overlap.
    """

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Return a depth map with z-depth 1 at every pixel."""
        return DepthPrior.from_arrays(np.ones(FLAT_GRID), metric=False)
