"""Small ONNX models in text syntax, for unit tests and provider contract tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import ArrayLike


def save_model(text: str, path: Path, **arrays: ArrayLike) -> Path:
    """Write an ONNX model from ONNX's text syntax, with the constant tensors ``arrays``.

    For example, call ``save_model("tiny (float[1,3,h,w] image) => (float[1,1,h,w] depth) {...}",
    path, weight=w)``. The constant tensors keep their dtype, except that float64 becomes float32.
    """
    model = onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["" : 17]> {text}')
    for name, values in arrays.items():
        array = np.asarray(values)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        model.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)
    return path
