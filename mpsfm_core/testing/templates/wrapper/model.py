from dataclasses import replace

import numpy as np

from mpsfm_core import Options


class ${Class}Options(Options):
    factor: float = 2.0


class $Class:
    """Scale the std of a provider: put your second pass, tiling or ensemble here."""

    def __init__(self, inner, options, context):
        self._inner = inner
        self._factor = np.float32(options.factor**2)

    def predict(self, view, depth=None):
        prior = self._inner.predict(view) if depth is None else self._inner.predict(view, depth)
        variance = None if prior.variance is None else self._factor * prior.variance
        return replace(prior, variance=variance)
