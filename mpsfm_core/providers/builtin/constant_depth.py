"""Depth provider without any prior knowledge, the fallback if no network is installed."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext

_GRID = (24, 32)
"""Rows and columns of the map; normals from depth need some pixels."""


class ConstantDepth:
    """Depth provider that returns a plane parallel to the image at distance 1, not metric.

    With the large std that its specification declares, the mapper can lift keypoints for a first
    pose. Images with much overlap are then reconstructed nearly as without priors.
    """

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Return depth 1 everywhere."""
        return DepthPrior.from_arrays(np.ones(_GRID), metric=False)
