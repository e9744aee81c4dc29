"""Inference session for an ONNX file, with tensors by name."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime  # type: ignore[import-untyped]
from numpy.typing import NDArray

from mpsfm_core import ProviderContext
from mpsfm_core.data.errors import ConfigError, WeightsError

_log = logging.getLogger(__name__)
_ERRORS_ONLY = 3
_DTYPES: Mapping[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
}


class Model:
    """Inference session, on the GPU if the context requests one and onnxruntime supports it.

    ``inputs`` and ``outputs`` are the names of the tensors in the order of the model. ``shapes``
    are the input shapes by name, where dynamic axes are strings or None.

    Raises:
        WeightsError: The file is not an ONNX model.
    """

    def __init__(self, path: Path, context: ProviderContext) -> None:
        self._name = path.name
        self._session = _open(path, context)
        inputs = self._session.get_inputs()
        self._dtypes = {tensor.name: _DTYPES.get(tensor.type) for tensor in inputs}
        self.inputs = tuple(self._dtypes)
        self.shapes = {tensor.name: tuple(tensor.shape) for tensor in inputs}
        self.outputs = tuple(tensor.name for tensor in self._session.get_outputs())

    def require(self, inputs: Iterable[str], outputs: Iterable[str], what: str) -> None:
        """Check that the ONNX model has exactly the given inputs, and at least the given outputs.

        Args:
            inputs: Names of all input tensors.
            outputs: Names of the required output tensors.
            what: Name of the network for the error message.

        Raises:
            ConfigError: The ONNX model has other inputs, or lacks required outputs.
        """
        inputs, outputs = sorted(set(inputs)), sorted(set(outputs))
        if inputs != sorted(self.inputs) or not set(outputs) <= set(self.outputs):
            raise ConfigError(
                f"{what} needs inputs {inputs} and outputs {outputs}; {self._name} has inputs "
                f"{list(self.inputs)} and outputs {list(self.outputs)}"
            )

    def run(self, feed: Mapping[str, Any], outputs: Sequence[str]) -> list[NDArray[Any]]:
        """Run the model on inputs that are cast (and rounded) to the dtypes of the model."""
        tensors = {name: self._cast(value, self._dtypes[name]) for name, value in feed.items()}
        results: list[NDArray[Any]] = self._session.run(list(outputs), tensors)
        return results

    @staticmethod
    def _cast(value: Any, dtype: type[np.generic] | None) -> NDArray[Any]:
        if dtype is not None and np.issubdtype(dtype, np.integer):
            value = np.rint(value)
        array: NDArray[Any] = np.asarray(value, dtype=dtype, order="C")
        return array


def _open(path: Path, context: ProviderContext) -> onnxruntime.InferenceSession:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = context.threads
    settings.inter_op_num_threads = 1
    settings.use_deterministic_compute = True
    settings.log_severity_level = _ERRORS_ONLY
    wanted = ["CUDAExecutionProvider"] if context.device == "cuda" else []
    available = onnxruntime.get_available_providers()
    providers = [p for p in [*wanted, "CPUExecutionProvider"] if p in available]
    try:
        session = onnxruntime.InferenceSession(str(path), settings, providers=providers)
    except Exception as error:  # the exceptions of onnxruntime share no base class
        reason = str(error).strip().splitlines()[0]
        raise WeightsError(
            f"the file {path} cannot be opened as an ONNX model: {reason}"
        ) from error
    if not set(wanted) <= set(
        session.get_providers()
    ):  # onnxruntime may list CUDA as available although the CUDA libraries are missing
        _log.warning("%s runs on the CPU: onnxruntime cannot use the GPU here", path.name)
    return session
