"""Sky masks from a segmentation network in an ONNX file."""

from __future__ import annotations

from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.decode import to_planes
from mpsfm_onnx.description import FixedSize, ImageInput
from mpsfm_onnx.model import Model

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool
from mpsfm_core.geometry import resize_map
from mpsfm_sky.options import SkyOptions

_INPUTS = {
    "skyseg": ImageInput(
        scale=1 / 255,
        mean=(0.485, 0.456, 0.406),
        std=(0.229, 0.224, 0.225),
        size=FixedSize(mode="fixed", width=320, height=320),
    ),
    "skysegsmall": ImageInput(scale=1 / 255, size=FixedSize(mode="fixed", width=384, height=384)),
}


class SkyNetwork:
    """Network with one image as input and the sky probability as first output.

    The reference implementation stretches the output range of each image to 0..1, which finds sky
    in images without sky. This provider uses the predicted sky probability without stretching its
    range.
    """

    def __init__(self, options: SkyOptions, context: ProviderContext) -> None:
        self._model = Model(context.resolve_weights(options.model, options.sha256), context)
        self._image, self._sky = self._model.inputs[0], self._model.outputs[0]
        self._model.require([self._image], [self._sky], "a sky network")
        self._rule = _INPUTS[options.network]
        self._threshold = options.threshold

    def mask(self, view: View) -> Bool:
        """Predict a mask of the image size that is False on sky."""
        canvas = Canvas.plan(self._rule.size, view.camera.size)
        feed = {self._image: canvas.paint(view.image, self._rule)}
        sky = to_planes(self._model.run(feed, [self._sky])[0], "NCHW")[..., 0]
        keep: Bool = resize_map(sky, *view.camera.size) <= self._threshold
        return keep
