"""Providers of depth, normals, a mask and cameras that run the compact network."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import Description, Weights, load_description
from mpsfm_onnx.model import Model
from mpsfm_onnx.network import Network
from mpsfm_onnx.providers import DescribedJoint, DescribedNormals

from mpsfm_compact.options import CameraOptions, CompactOptions
from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool
from mpsfm_core.geometry import resize_map
from mpsfm_core.providers.kinds.camera import CameraPrior

MAX_FOCAL_STD = 0.5
"""Largest std of the log focal length of an estimate. The provider returns no estimate if the std
is larger, because the default focal length of a photo has a std of 0.7.
"""
_IMAGE = "image"
_CAMERA = ("focal", "focal_std", "gravity", "gravity_std", "radial", "radial_std")


class CompactDepth(DescribedJoint):
    """Provider of metric depth and normals from one forward pass of the compact network."""

    def __init__(self, options: CompactOptions, context: ProviderContext) -> None:
        super().__init__(describe(options), context)


class CompactNormals(DescribedNormals):
    """Provider of normals and their angular variance from the compact network."""

    def __init__(self, options: CompactOptions, context: ProviderContext) -> None:
        super().__init__(describe(options), context)


class CompactMask:
    """Provider of a mask that excludes sky, mirrors and glass."""

    def __init__(self, options: CompactOptions, context: ProviderContext) -> None:
        self._network = Network(describe(options), context)

    def mask(self, view: View) -> Bool:
        """Predict a mask of the image size that is False on sky, mirrors and glass."""
        rule, answer = self._network.description.outputs.mask, self._network.run(view)
        assert rule is not None
        probability = resize_map(answer.maps[rule.name][..., 0], *view.camera.size)
        keep: Bool = probability > rule.minimum
        return keep


class CompactCamera:
    """Provider of the focal length, radial distortion and gravity of a centered camera."""

    def __init__(self, options: CameraOptions, context: ProviderContext) -> None:
        self._input = describe(CompactOptions()).input
        path = context.resolve_weights(options.weights, options.sha256)
        self._model = Model(path, context)
        self._model.require({_IMAGE}, _CAMERA, "compact camera")

    def calibrate(self, view: View) -> CameraPrior | None:
        """Estimate the camera of a view, or return None if the focal length is too uncertain."""
        canvas = Canvas.plan(self._input.size, view.camera.size)
        feed = {_IMAGE: canvas.paint(view.image, self._input)}
        outputs = self._model.run(feed, _CAMERA)
        focal, focal_std, gravity, gravity_std, radial, radial_std = (
            x.reshape(-1) for x in outputs
        )
        if not 0 < focal_std[0] <= MAX_FOCAL_STD:
            return None
        # The image sides are scaled by slightly different factors to multiples of 32 pixels.
        scales = [new / old for new, old in zip(canvas.image, view.camera.size, strict=True)]
        focal_px = float(focal[0]) / math.sqrt(scales[0] * scales[1])
        down = gravity.astype(np.float64)
        return CameraPrior(
            focal_px,
            focal_px * float(focal_std[0]),
            radial=float(radial[0]),
            radial_std=float(radial_std[0]),
            gravity=down / np.linalg.norm(down),
            gravity_std_deg=math.degrees(float(gravity_std[0])),
        )


def describe(options: CompactOptions) -> Description:
    """Return the compact network's description with the weights and input size of ``options``."""
    general = load_description(str(Path(__file__).with_name("description.yaml")))
    size = general.input.size.model_copy(update={"side": options.size})
    update = {
        "weights": Weights(uri=options.weights, sha256=options.sha256),
        "input": general.input.model_copy(update={"size": size}),
    }
    return general.model_copy(update=update)
