"""SuperPoint and DISK in ONNX files as feature providers."""

from __future__ import annotations

import numpy as np
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import ImageInput, SideSize
from mpsfm_onnx.model import Model

from mpsfm_core import Features, ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_core.geometry import inside, sample_nearest
from mpsfm_lightglue_onnx.options import DiskOptions, FeatureOptions, SuperPointOptions

_OUTPUTS = ("keypoints", "scores", "descriptors")
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Luma coefficients of ITU-R BT.601, as in LightGlue's image reader."""


class OnnxFeatures:
    """Base class of the feature extractors that LightGlue-ONNX exports.

    The input ``image`` (1, c, h, w) of the ONNX file has values in [0, 1]. The output ``keypoints``
    (1, n, 2) is in pixels of ``image``, with the center of the first pixel at (0, 0). Further
    outputs of the ONNX file are keypoint ``scores`` (1, n) and ``descriptors`` (1, n, d).
    """

    multiple = 8
    """The sides of the detector's network input are rounded to multiples of ``multiple`` pixels."""

    def __init__(self, options: FeatureOptions, context: ProviderContext, model: str) -> None:
        self._model = Model(context.resolve_weights(model, options.sha256), context)
        self._model.require(("image",), _OUTPUTS, type(self).__name__)
        self._options = options

    def channels(self, rgb: Float32) -> Float32:
        """Convert an RGB image (1, 3, h, w) in [0, 1] to the input channels of the network."""
        return rgb

    def extract(self, view: View) -> Features:
        """Extract the strongest keypoints inside the view and its mask, by decreasing score.

        The keypoint noise ``std_px`` is 1 pixel of the view, or one pixel of the resized image if
        that is larger.
        """
        longest = max(view.camera.size)
        side = min(longest, self._options.resize or longest)
        size = SideSize(mode="longest", side=side, multiple_of=self.multiple)
        canvas = Canvas.plan(size, view.camera.size)
        image = canvas.paint(view.image, ImageInput(scale=1 / 255, size=size))
        results = self._model.run({"image": self.channels(image)}, _OUTPUTS)
        xy, scores, descriptors = (tensor[0] for tensor in results)
        keypoints = canvas.to_view(xy.astype(np.float64) + 0.5, view.camera.size)
        order = np.argsort(-scores, kind="stable")
        usable = inside(keypoints[order], view.camera.size)
        if view.mask is not None:
            usable &= sample_nearest(view.mask, keypoints[order])
        order = order[usable][: self._options.max_keypoints]
        pixel = max(v / i for v, i in zip(view.camera.size, canvas.image, strict=True))
        return Features(
            keypoints[order],
            descriptors[order].astype(np.float32),
            np.clip(scores[order], 0, 1).astype(np.float32),
            std_px=max(1.0, pixel),
        )


class SuperPoint(OnnxFeatures):
    """SuperPoint features, detected in gray images."""

    def __init__(self, options: SuperPointOptions, context: ProviderContext) -> None:
        super().__init__(options, context, options.model)

    def channels(self, rgb: Float32) -> Float32:
        """Compute the luma (1, 1, h, w) of an RGB image."""
        return np.tensordot(rgb, _LUMA, axes=(1, 0))[:, np.newaxis]


class Disk(OnnxFeatures):
    """DISK features, from a network whose input sides are multiples of 16 pixels."""

    multiple = 16

    def __init__(self, options: DiskOptions, context: ProviderContext) -> None:
        super().__init__(options, context, options.model)
