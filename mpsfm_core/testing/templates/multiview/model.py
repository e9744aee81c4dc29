import numpy as np

from mpsfm_core import DepthPrior, MultiViewPrior, Options


class ${Class}Options(Options):
    weights: str  # a path, or hf://ORG/REPO@REVISION/FILE, https://..., package:...
    sha256: str | None = None


class $Class:
    def __init__(self, options, context):
        self._network = Network(context.resolve_weights(options.weights, options.sha256))

    def predict_group(self, views):
        depth = self._network([view.image / np.float32(255) for view in views])
        # A network that predicts relative poses passes poses=cam_from_group (n, 3, 4) and declares
        # the capability proposes-poses; predicted intrinsics are passed as intrinsics= (n, 4).
        return MultiViewPrior(tuple(DepthPrior.from_arrays(map) for map in depth))


class Network:  # replace by your network; this example is an affine function of a pixel's color
    def __init__(self, path):
        with np.load(path) as weights:
            self._weights, self._bias = weights["weights"], weights["bias"]

    def __call__(self, images):  # z-depth of each view, all in the same unit (meters)
        return [rgb @ self._weights + self._bias for rgb in images]
