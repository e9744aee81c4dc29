"""Depth that knows nothing of the scene, so that there always is some."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext

_GRID = (24, 32)
"""Of a constant any grid is as good; normals from depth want a few pixels."""


class ConstantDepth:
    """A plane parallel to the image, at a distance of 1 in no known unit.

    With the large std that it declares the mapper can lift keypoints to begin with, and photos
    that overlap well are reconstructed nearly as without priors.
    """

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Depth 1 everywhere, not metric."""
        return DepthPrior.from_arrays(np.ones(_GRID), metric=False)
