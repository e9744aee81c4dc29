"""Small ONNX network that replaces the trained one in the provider contract tests."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.contract import stand_in

from mpsfm_compact.options import CompactOptions
from mpsfm_compact.provider import describe
from mpsfm_core.testing import ContractSetup


def setup(folder: Path) -> ContractSetup:
    """Write a test network with the tensors of ``compact`` that decodes depth from image colors."""
    model = stand_in(describe(CompactOptions()), folder)
    return ContractSetup(options={"weights": str(model)}, truth_source="painted")


def camera(folder: Path) -> ContractSetup:
    """Write a test network with the tensors of the camera network, whose angle of view is fixed.

    The trained network returns no estimate for painted views, because its std is too large.
    """
    import onnx
    from onnx import TensorProto, helper

    def constant(name: str, values: list[float]) -> onnx.NodeProto:
        tensor = helper.make_tensor(name, TensorProto.FLOAT, [1, len(values)], values)
        return helper.make_node("Constant", [], [name], value=tensor)

    nodes = [
        helper.make_node("Shape", ["image"], ["sides"], start=3, end=4),
        helper.make_node("Cast", ["sides"], ["width"], to=TensorProto.FLOAT),
        constant("ratio", [0.9]),
        helper.make_node("Mul", ["width", "ratio"], ["focal"]),
        constant("focal_std", [0.2]),
        constant("gravity", [0.0, 1.0, 0.0]),
        constant("gravity_std", [0.2]),
        constant("radial", [0.0]),
        constant("radial_std", [0.05]),
    ]
    shape: list[str | int | None] = [1, 3, "height", "width"]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
        for name in ("focal", "focal_std", "gravity", "gravity_std", "radial", "radial_std")
    ]
    graph = helper.make_graph(nodes, "camera", [image], outputs)
    opset = [helper.make_opsetid("", 18)]
    path = folder / "camera.onnx"
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return ContractSetup(options={"weights": str(path)})
