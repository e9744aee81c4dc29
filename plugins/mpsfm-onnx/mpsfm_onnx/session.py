"""A network in an ONNX file, run on one view at a time."""

from __future__ import annotations

from pathlib import Path

import onnxruntime

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_core.errors import ConfigError, WeightsError
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.decode import planes
from mpsfm_onnx.description import Description, load_description
from mpsfm_onnx.options import OnnxOptions

_ERRORS_ONLY = 3


class Network:
    """The network that the options name: its description and its inference session.

    Raises:
        ConfigError: the model does not have the tensors of its description.
        WeightsError: the file is missing, or is no ONNX model.
    """

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        self.description = load_description(options.description)
        path = _model_file(self.description, options, context)
        self._session = _open(path, context)
        self._input, self._outputs = self._match_tensors(path)

    def run(self, view: View) -> tuple[dict[str, Float32], Canvas]:
        """Output tensors by name, (h, w, c), cut to the view; and where the view was placed."""
        rule = self.description.input
        canvas = Canvas.plan(rule.size, view.camera.size)
        feed = {self._input: canvas.paint(view.image, rule)}
        layout = self.description.outputs.layout
        results = zip(self._outputs, self._session.run(self._outputs, feed), strict=True)
        return {name: canvas.cut(planes(tensor, layout)) for name, tensor in results}, canvas

    def _match_tensors(self, path: Path) -> tuple[str, list[str]]:
        """Names of the input and of the outputs to compute, checked against the model."""
        inputs = [tensor.name for tensor in self._session.get_inputs()]
        given = [tensor.name for tensor in self._session.get_outputs()]
        name = self.description.input.name or inputs[0]
        outputs = self.description.outputs
        described = [outputs.depth, outputs.normals, outputs.kappa]
        wanted = {tensor.name for tensor in described if tensor}
        if outputs.confidence and (
            outputs.confidence.name in given or not outputs.confidence.optional
        ):
            wanted.add(outputs.confidence.name)
        if inputs != [name] or not wanted <= set(given):
            raise ConfigError(
                f"description {self.description.name!r} wants input {name!r} and outputs "
                f"{sorted(wanted)}; {path.name} has inputs {inputs} and outputs {given}"
            )
        return name, sorted(wanted)


def _model_file(description: Description, options: OnnxOptions, context: ProviderContext) -> Path:
    if options.model is not None:
        return context.resolve_weights(options.model, options.sha256)
    if description.weights is None:
        raise WeightsError(
            f"the description {description.name!r} has no public weights file: "
            f"name yours with --set depth.options.model=FILE"
        )
    for companion in description.weights.companions:
        context.resolve_weights(companion, None)
    return context.resolve_weights(description.weights.uri, description.weights.sha256)


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
        return onnxruntime.InferenceSession(str(path), settings, providers=providers)
    except Exception as error:  # onnxruntime's exceptions share no base class
        reason = str(error).strip().splitlines()[0]
        raise WeightsError(f"{path} cannot be opened as an ONNX model: {reason}") from error
