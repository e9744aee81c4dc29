"""Global image descriptors from a network in an ONNX file."""

from __future__ import annotations

import numpy as np
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import FixedSize, ImageInput, SideSize
from mpsfm_onnx.model import Model

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_retrieval.options import NetworkOptions

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_INPUTS = {
    "dinov2": ImageInput(
        scale=1 / 255,
        mean=_MEAN,
        std=_STD,
        interpolation="cubic",
        # DINOv2's own preprocessing crops the 224 x 224 center, which shows only a part of the
        # image.
        size=SideSize(mode="longest", side=336, multiple_of=14),
    ),
    "eigenplaces": ImageInput(
        scale=1 / 255,
        mean=_MEAN,
        std=_STD,
        size=FixedSize(mode="fixed", width=512, height=512),
    ),
    "netvlad": ImageInput(scale=1 / 255, size=SideSize(mode="longest", side=1024, enlarge=False)),
}


class GlobalNetwork:
    """Network with one image as input and a descriptor as first output.

    The output is a vector (1, d), tokens (1, t, d) whose first token is used, or a map (1, d, h, w)
    that is averaged. The descriptor is normalized to unit length.
    """

    def __init__(self, options: NetworkOptions, context: ProviderContext) -> None:
        self._model = Model(context.resolve_weights(options.model, options.sha256), context)
        self._image, self._output = self._model.inputs[0], self._model.outputs[0]
        self._model.require([self._image], [self._output], "a retrieval network")
        self._rule = _INPUTS[options.network]

    def describe(self, view: View) -> Float32:
        """Compute the unit descriptor (d,) of a view."""
        canvas = Canvas.plan(self._rule.size, view.camera.size)
        feed = {self._image: canvas.paint(view.image, self._rule)}
        output = self._model.run(feed, [self._output])[0][0].astype(np.float32)
        if output.ndim == 3:
            output = output.mean(axis=(1, 2))
        elif output.ndim == 2:
            output = output[0]
        unit: Float32 = output / max(float(np.linalg.norm(output)), 1e-12)
        return unit
