"""Choices of depth that another block of the configuration gives."""

from __future__ import annotations

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext


class MatcherDepth:
    """Stands in the configuration as ``depth: {use: matcher}`` (the paper's MASt3R configuration).

    The extraction takes the depth from the pairs that the matcher has predicted, the most certain
    pair of each image. One view alone has no pair, so that asking for it is an error.
    """

    source = "the pairs of a matcher that predicts depth"

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Always raises :class:`ProviderError`."""
        raise ProviderError(
            f"the depth of {view.name!r} comes from {self.source}; it cannot be predicted from one "
            f"view"
        )


class MultiViewDepth(MatcherDepth):
    """Stands in the configuration as ``depth: {use: multiview}``: the extraction takes the depth
    from the groups of photos that the multi-view network was shown."""

    source = "a multi-view network"
