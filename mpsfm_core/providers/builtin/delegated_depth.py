"""Placeholders for depth predicted by a dense matcher or a multi-view network."""

from __future__ import annotations

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext


class MatcherDepth:
    """Placeholder depth provider for the option ``depth.use=matcher``.

    A matcher such as MASt3R predicts the depth of both images of a pair. Feature extraction uses,
    for each image, the depth from the image pair with the smallest depth uncertainty, as the paper
    does with MASt3R. A depth provider receives a single image instead of a pair, so :meth:`predict`
    always raises an error.
    """

    source = "the pairs of a matcher that predicts depth"

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View) -> DepthPrior:
        """Raise an error, because the matcher predicts depth only for image pairs.

        Raises:
            ProviderError: Every call raises the error, because a matcher needs two images.
        """
        raise ProviderError(
            f"the depth of {view.name!r} is predicted by {self.source}, not from a single image"
        )


class MultiViewDepth(MatcherDepth):
    """Placeholder depth provider for the option ``depth.use=multiview``.

    A multi-view network predicts depth for several images jointly. Feature extraction takes the
    depth of each image from the network's joint prediction.
    """

    source = "a multi-view network"
