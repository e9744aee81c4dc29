import numpy as np

from mpsfm_core import NormalPrior, Options


class ${Class}Options(Options):
    weights: str  # a path, or hf://ORG/REPO@REVISION/FILE, https://..., package:...
    sha256: str | None = None


class $Class:
    def __init__(self, options, context):
        self._network = Network(context.resolve_weights(options.weights, options.sha256))

    def predict(self, view, depth=None):
        normals = self._network(view.image / np.float32(255))  # x right, y down, z forward
        return NormalPrior.from_arrays(normals, camera=view.camera)


class Network:  # replace by your network; this example is an affine function of a pixel's color
    def __init__(self, path):
        with np.load(path) as weights:
            self._weights, self._bias = weights["weights"], weights["bias"]

    def __call__(self, rgb):
        return rgb @ self._weights.T + self._bias
