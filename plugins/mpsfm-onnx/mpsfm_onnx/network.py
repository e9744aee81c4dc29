"""Network in an ONNX file, whose tensors are described in YAML, for one view at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.data import Float32, Float64
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.decode import to_planes
from mpsfm_onnx.description import Description, FixedSize, ImageInput, IntrinsicsInput, SideSize
from mpsfm_onnx.model import Model


@dataclass(frozen=True)
class NetworkOutput:
    """Outputs of a network for a view, as maps (h, w, c) and single numbers, by tensor name.

    All output maps cover exactly the view. ``canvas`` is the position of the view on the network
    input.
    """

    maps: dict[str, Float32]
    numbers: dict[str, float]
    canvas: Canvas


class Network:
    """Network in an ONNX file, with a description of its tensors.

    Args:
        weights: Path or URI of the ONNX file. None selects the ONNX file that the description
            names.
        sha256: Expected SHA-256 hash of the file ``weights``.

    Raises:
        ConfigError: The ONNX model lacks tensors that its description names.
        WeightsError: The ONNX file is missing or invalid.
    """

    def __init__(
        self,
        description: Description,
        context: ProviderContext,
        weights: str | None = None,
        sha256: str | None = None,
    ) -> None:
        self.description = description
        for file in description.files(weights, sha256):
            path = context.resolve_weights(file.uri, file.sha256)
        self._model = Model(path, context)
        rule = description.input
        self._image = rule.name or self._model.inputs[0]
        inputs = {self._image, *rule.constants}
        if rule.intrinsics is not None:
            inputs.add(rule.intrinsics.name)
        if rule.rays is not None:
            inputs.add(rule.rays)
        self._outputs = sorted(description.outputs.names())
        self._model.require(inputs, self._outputs, f"description {description.name!r}")
        self._size = _own_size(rule, self._model.shapes[self._image])

    def run(self, view: View) -> NetworkOutput:
        """Run the network on a view, and return output maps that cover the view."""
        rule, outputs = self.description.input, self.description.outputs
        canvas = Canvas.plan(self._size, view.camera.size)
        feed = {self._image: canvas.paint(view.image, rule), **rule.constants}
        if rule.intrinsics is not None:
            feed[rule.intrinsics.name] = _matrix(canvas.camera(view.camera), rule.intrinsics)
        if rule.rays is not None:
            feed[rule.rays] = _unit_rays(canvas.camera(view.camera))
        results = zip(self._outputs, self._model.run(feed, self._outputs), strict=True)
        maps, numbers = {}, {}
        for name, tensor in results:
            if name in outputs.numbers():
                numbers[name] = float(tensor.reshape(-1)[0])
            else:
                maps[name] = canvas.cut(to_planes(tensor, outputs.layout))
        return NetworkOutput(maps, numbers, canvas)


def _own_size(rule: ImageInput, shape: tuple[object, ...]) -> FixedSize | SideSize:
    """Return the input size of a description, or the size that the ONNX file fixes."""
    height, width = shape[2:4] if rule.layout == "NCHW" else shape[1:3]
    if isinstance(rule.size, FixedSize) and isinstance(height, int) and isinstance(width, int):
        return rule.size.model_copy(update={"width": width, "height": height})
    return rule.size


def _unit_rays(camera: PinholeCamera) -> Float64:
    """Compute unit rays (1, 3, h, w) through the pixel centers of a camera."""
    through = rays(camera, pixel_centers(*camera.size))
    unit: Float64 = through / np.linalg.norm(through, axis=-1, keepdims=True)
    return unit.transpose(2, 0, 1)[np.newaxis]


def _matrix(camera: PinholeCamera, rule: IntrinsicsInput) -> Float64:
    """Compute the calibration matrix K (1, 3, 3) in the pixel convention of the network."""
    matrix = camera.matrix
    matrix[:2, 2] -= 0.5 - rule.first_pixel
    return matrix[np.newaxis]
