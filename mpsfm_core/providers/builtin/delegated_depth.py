"""Placeholders for depth that another block of the configuration predicts."""

from __future__ import annotations

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext


class MatcherDepth:
    """Placeholder for ``depth: {use: matcher}``: depth predicted by the matcher.

    The extraction takes the depth of each image from its most certain pair, as the MASt3R
    configuration of the paper does. A single view has no pair, so that :meth:`predict` always
    fails.
    """

    source = "the pairs of a matcher that predicts depth"

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Raise an error: one view has no matches.

        Raises:
            ProviderError: Always.
        """
        raise ProviderError(
            f"the depth of {view.name!r} comes from {self.source}; it cannot be predicted from one "
            f"view"
        )


class MultiViewDepth(MatcherDepth):
    """Placeholder for ``depth: {use: multiview}``: depth of the multi-view network.

    The extraction takes the depth from the groups of images that the network received.
    """

    source = "a multi-view network"
