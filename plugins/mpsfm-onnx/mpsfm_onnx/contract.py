"""Small ONNX networks for contract tests that decode depth and normals from image colors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from mpsfm_core.data import Float64
from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.examples import outdoor_example
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD, decoder
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import Description, ImageInput, load_description
from mpsfm_onnx.stand_in import save_model

KAPPA = (1 + np.sqrt(1 - NORMALS_STD**2)) / NORMALS_STD
"""Concentration kappa of normals whose expected angular error is :data:`NORMALS_STD`."""

_TINY = """
name: tiny
input:
  name: image
  scale: 0.01
  mean: [0.5, 1.0, 1.5]
  std: [2.0, 3.0, 4.0]
  size: {mode: shortest, side: 112, multiple_of: 14, fit: pad, enlarge: false}
outputs:
  depth: {name: depth, metric: true, canonical_focal: 100.0}
  confidence: {name: confidence, output: confidence}
  normals: {name: normals, axes: [-1, 1, 1]}
  kappa: {name: normals, channel: 3}
"""


_MOGE = """
moge (float[1,3,h,w] image, int64 num_tokens) => (
    float[1,h,w,3] points, float[1,h,w,3] normal, float[1,h,w] mask, float[1] scale) {
    gray = ReduceMean <axes = [1]> (image)
    zeros = Mul (gray, none)
    ones = Add (zeros, whole)
    z = Add (gray, ones)
    column = CumSum (ones, columns)
    row = CumSum (ones, rows)
    width = ReduceMax <axes = [3]> (column)
    height = ReduceMax <axes = [2]> (row)
    middle_u = Mul (width, half)
    middle_v = Mul (height, half)
    center_u = Sub (column, half)
    center_v = Sub (row, half)
    right = Sub (center_u, middle_u)
    down = Sub (center_v, middle_v)
    slope_u = Div (right, width)
    slope_v = Div (down, width)
    x = Mul (z, slope_u)
    y = Mul (z, slope_v)
    xyz = Concat <axis = 1> (x, y, z)
    points = Transpose <perm = [0, 2, 3, 1]> (xyz)
    towards = Neg (ones)
    facing = Concat <axis = 1> (zeros, zeros, towards)
    normal = Transpose <perm = [0, 2, 3, 1]> (facing)
    mask = ReduceMax <axes = [1], keepdims = 0> (ones)
    scale = Identity (metres)
}
"""


def setup(folder: Path) -> ContractSetup:
    """Write a network whose description has a canonical camera, padding and confidences."""
    return ContractSetup(options=_tiny(folder), truth_source="painted")


def moge(folder: Path) -> ContractSetup:
    """Write a network with the tensors of MoGe-2's published file."""
    return ContractSetup(
        options={"weights": str(moge_stand_in(folder / "moge.onnx"))}, truth_source="none"
    )


def moge_stand_in(path: Path) -> Path:
    """Write a network with the inputs and outputs of MoGe-2's published file.

    Depth grows with brightness from 2 to 4 m, and the focal length is the image width.
    """
    return save_model(_MOGE, path, half=0.5, none=0.0, whole=1.0, rows=2, columns=3, metres=[2.0])


def stand_in(description: Description, folder: Path) -> Path:
    """Write an ONNX network that decodes depth and normals from the colors of test images.

    The description must have a named input, NCHW tensors, ``output: depth`` and an uncertainty of
    the normals. Pixels whose color encodes no depth are invalid. If the description has a canonical
    focal length, the network assumes the focal length of the main test image.
    """
    outputs, rule = description.outputs, description.input
    weights, bias = _unnormalised(rule)
    graph = _Graph(str(rule.name))
    graph.add("Conv", graph.image, graph.array(weights), graph.array(bias), to="painted")
    graph.add("Split", "painted", graph.array([1, 3]), to=("metres", "slopes"), axis=1)
    graph.add("Mul", "metres", graph.array([0.0]), to="nothing")
    if outputs.depth is not None:
        unit = graph.array([_canonical_unit(description)])
        graph.add("Mul", "metres", unit, to=outputs.depth.name)
    if outputs.confidence is not None and outputs.confidence.output == "confidence":
        graph.add("Add", "nothing", graph.array([1 - RELATIVE_STD]), to=outputs.confidence.name)
    elif outputs.confidence is not None:  # std, not variance
        share = graph.array([RELATIVE_STD * _canonical_unit(description)])
        graph.add("Mul", "metres", share, to=outputs.confidence.name)
    if outputs.mask is not None:
        graph.add("Mul", "metres", graph.array([1e3]), to="steep")
        graph.add("Min", "steep", graph.array([1.0]), to=outputs.mask.name)
    if outputs.normals is not None and outputs.kappa is not None:
        normals, kappa = outputs.normals.name, outputs.kappa.name
        parts = (normals, kappa) if normals != kappa else ("towards", "concentration")
        axes = np.array(outputs.normals.axes, dtype=np.float64).reshape(1, 3, 1, 1)
        graph.add("Mul", "slopes", graph.array(axes), to=parts[0])
        certainty = KAPPA if outputs.kappa.output == "kappa" else NORMALS_STD
        graph.add("Add", "nothing", graph.array([certainty]), to=parts[1])
        if normals == kappa:
            graph.add("Concat", *parts, to=normals, axis=1)
    intrinsics_name = rule.intrinsics.name if rule.intrinsics else None
    return graph.save(sorted(outputs.names()), intrinsics_name, folder / f"{description.name}.onnx")


class _Graph:
    """ONNX graph under construction, with one image (1, 3, h, w) as input."""

    def __init__(self, image: str) -> None:
        self.image = image
        self._nodes: list[onnx.NodeProto] = []
        self._arrays: list[onnx.TensorProto] = []

    def array(self, values: ArrayLike) -> str:
        """Add a constant float32 or int64 tensor, and return its name."""
        array, name = np.asarray(values), f"array_{len(self._arrays)}"
        dtype = np.int64 if np.issubdtype(array.dtype, np.integer) else np.float32
        self._arrays.append(numpy_helper.from_array(array.astype(dtype), name))
        return name

    def add(self, kind: str, *inputs: str, to: str | tuple[str, ...], **attributes: Any) -> None:
        """Add a node."""
        outputs = (to,) if isinstance(to, str) else to
        self._nodes.append(helper.make_node(kind, inputs, outputs, **attributes))

    def save(self, outputs: Sequence[str], intrinsics: str | None, path: Path) -> Path:
        """Write the model, with an unused input (1, 3, 3) if ``intrinsics`` is given."""
        flat = TensorProto.FLOAT
        inputs = [helper.make_tensor_value_info(self.image, flat, [1, 3, "h", "w"])]
        if intrinsics is not None:
            inputs.append(helper.make_tensor_value_info(intrinsics, flat, [1, 3, 3]))
        results = [helper.make_tensor_value_info(name, flat, None) for name in outputs]
        graph = helper.make_graph(self._nodes, "stand_in", inputs, results, self._arrays)
        opset = [helper.make_opsetid("", 17)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
        return path


def _tiny(folder: Path) -> dict[str, str]:
    path = folder / "tiny.yaml"
    path.write_text(_TINY, encoding="utf-8")
    description = load_description(str(path))
    return {"description": str(path), "model": str(stand_in(description, folder))}


def _unnormalised(rule: ImageInput) -> tuple[Float64, Float64]:
    """Create the weights and bias that decode depth and surface slopes from normalized colors."""
    weights, bias = decoder()
    if rule.channels == "BGR":
        weights = weights[:, ::-1]
    mean, std = np.array(rule.mean), np.array(rule.std)
    bias = bias + weights @ mean / rule.scale
    return (weights * std / rule.scale)[..., None, None], bias


def _canonical_unit(description: Description) -> float:
    rule, camera = description.outputs.depth, outdoor_example("painted").camera
    if rule is None or rule.canonical_focal is None:
        return 1.0
    image = Canvas.plan(description.input.size, camera.size).image
    scale = max(width / full for width, full in zip(image, camera.size, strict=True))
    return rule.canonical_focal / ((camera.fx + camera.fy) / 2 * scale)
