"""Depth provider without any prior knowledge, the fallback if no network is installed."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext

_GRID = (24, 32)
"""Rows and columns of the constant depth map; normals from depth need several pixels."""


class ConstantDepth:
    """Depth provider that returns the plane z = 1 parallel to the image, without a metric unit.

    The specification declares a large std, with which the mapper can still lift keypoints to 3D.
    Images with much overlap are reconstructed almost as if there were no depth prior.
    """

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Return z-depth 1 at every pixel."""
        return DepthPrior.from_arrays(np.ones(_GRID), metric=False)
