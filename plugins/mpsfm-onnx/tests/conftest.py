"""Tiny networks with the interfaces of real ones, and views whose content is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from mpsfm_core import PinholeCamera, View

onnx = pytest.importorskip("onnx")
ModelMaker = Callable[..., Path]


@pytest.fixture
def make_model(tmp_path: Path) -> ModelMaker:
    """Writes an ONNX model of one image input.

    ``constants``: output name to the tensor it always is. ``channels``: output name to
    ``(channel, shape)``: that channel of the (1, 3, h, w) input as a tensor of the shape.
    """

    def make(
        input_name: str,
        shape: list[Any],
        constants: dict[str, NDArray[Any]] | None = None,
        channels: dict[str, tuple[int, list[int]]] | None = None,
        dtype: int = onnx.TensorProto.FLOAT,
    ) -> Path:
        helper, nodes, values, outputs = onnx.helper, [], [], []
        for name, value in (constants or {}).items():
            values.append(onnx.numpy_helper.from_array(value.astype(np.float32), f"{name}_is"))
            nodes.append(helper.make_node("Identity", [f"{name}_is"], [name]))
            outputs.append(helper.make_tensor_value_info(name, 1, list(value.shape)))
        for name, (channel, out_shape) in (channels or {}).items():
            values.append(onnx.numpy_helper.from_array(np.array([channel]), f"{name}_channel"))
            values.append(onnx.numpy_helper.from_array(np.array(out_shape), f"{name}_shape"))
            nodes += [
                helper.make_node("Gather", [input_name, f"{name}_channel"], [f"{name}_a"], axis=1),
                helper.make_node("Reshape", [f"{name}_a", f"{name}_shape"], [f"{name}_b"]),
                helper.make_node("Cast", [f"{name}_b"], [name], to=onnx.TensorProto.FLOAT),
            ]
            outputs.append(helper.make_tensor_value_info(name, 1, out_shape))
        graph = helper.make_graph(
            nodes,
            "tiny",
            [helper.make_tensor_value_info(input_name, dtype, shape)],
            outputs,
            values,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        path = tmp_path / "tiny.onnx"
        onnx.save(model, path)
        return path

    return make


@pytest.fixture
def write_description(tmp_path: Path) -> Callable[..., str]:
    """Writes a description file and returns its path."""

    def write(**fields: Any) -> str:
        path = tmp_path / "description.yaml"
        path.write_text(yaml.safe_dump({"name": "tiny", **fields}), encoding="utf-8")
        return str(path)

    return write


@pytest.fixture
def make_view() -> Callable[..., View]:
    """A view of a size, with a colour or an image."""

    def make(
        width: int,
        height: int,
        colour: tuple[int, int, int] = (0, 0, 0),
        focal: tuple[float, float] = (500.0, 500.0),
        image: NDArray[np.uint8] | None = None,
    ) -> View:
        if image is None:
            image = np.full((height, width, 3), colour, dtype=np.uint8)
        camera = PinholeCamera(width, height, *focal, width / 2, height / 2)
        return View("view.png", image, camera)

    return make
