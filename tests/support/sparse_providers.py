"""Detector and matcher without options, as base classes of providers in tests of the contract kit.

They import OpenCV and pycolmap, other than :mod:`tests.support.reference_providers`.
"""

from __future__ import annotations

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
