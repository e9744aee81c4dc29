"""Placeholder providers for depth that a matcher or a multi-view network predicts."""

from __future__ import annotations

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext


class MatcherDepth:
    """Placeholder for ``depth: {use: matcher}``: depth predicted by the matcher.

    Feature extraction takes the depth of each image from its pair with the most certain depth, as
    the MASt3R configuration of the paper does. A single view has no pair, so :meth:`predict` always
    raises an error.
    """

    source = "the pairs of a matcher that predicts depth"

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Raise an error, because a single view has no matches.

        Raises:
            ProviderError: Always.
        """
        raise ProviderError(
            f"the depth of {view.name!r} is predicted by {self.source}, not from a single view"
        )


class MultiViewDepth(MatcherDepth):
    """Placeholder for ``depth: {use: multiview}``: depth predicted by the multi-view network.

    Feature extraction takes the depth from the groups of images that the multi-view network
    received.
    """

    source = "a multi-view network"
