"""Test plugin that is installed only in another Python environment."""

import os
import signal
import sys
import time

import numpy as np

from mpsfm_core import DepthPrior, NormalPrior, Options, PairMatches, ProviderSpec, hookimpl
from mpsfm_core.data import DenseMatches
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.painted_views import decoder


class FarOptions(Options):
    mode: str = "painted"
    weights: str | None = None
    bias: float = 0.0


class Far:
    """Depth provider for painted views that can fail in the typical ways of networks."""

    def __init__(self, options, context):
        self._mode, self._bias = options.mode, options.bias
        self.path = context.resolve_weights(options.weights, None) if options.weights else None
        if options.mode == "unbuildable":
            raise ImportError("libcudart.so.13: cannot open")

    def predict(self, view):
        return self.predict_joint(view)[0]

    def predict_joint(self, view):
        sys.stdout.write("a network that talks\n")
        weights, bias = decoder()
        painted = view.image.astype(np.float64) @ weights.T + bias
        if view.name == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        if view.name == "memory":
            os.kill(os.getpid(), signal.SIGKILL)
        if view.name == "exit":
            os.write(2, b"goodbye\n")
            os._exit(3)
        if view.name == "hang":
            time.sleep(600)
        if view.name == "error":
            raise IndexError("tensor of 3 dimensions")
        if view.name == "ours":
            raise WeightsError("far.pt is damaged")
        depth = DepthPrior.from_arrays(painted[..., 0] + self._bias)
        return depth, NormalPrior.from_arrays(painted[..., 1:], camera=view.camera)


class FarMatcher:
    """Matcher that matches equal pixel positions."""

    def __init__(self, options, context):
        pass

    def match(self, view_a, view_b, features_a=None, features_b=None):
        xy = np.array([[0.5, 0.5]])
        return PairMatches(dense=DenseMatches(xy, xy.copy(), np.ones(1, dtype=np.float32)))


def contract(folder):
    return ContractSetup(options={"mode": "painted"}, truth_source="painted")


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="depth",
            name="far",
            factory="far_plugin:Far",
            options=FarOptions,
            capabilities=frozenset({"metric", "joint-normals"}),
            contract="far_plugin:contract",
            code_license="MIT",
        ),
        ProviderSpec(
            kind="matcher",
            name="far-matcher",
            factory="far_plugin:FarMatcher",
            capabilities=frozenset({"dense"}),
        ),
    ]
