"""Networks in ONNX files as depth and normals providers."""

from __future__ import annotations

from mpsfm_core import DepthPrior, NormalPrior, ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_core.errors import ConfigError
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.decode import decode_depth, decode_normals
from mpsfm_onnx.description import DepthOutput, Description, NormalsOutput
from mpsfm_onnx.options import OnnxOptions
from mpsfm_onnx.session import Network


class OnnxDepth:
    """Depth, with the network's variance if it gives one."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        self._network = Network(options, context)
        self._rule = _depth_rule(self._network.description)

    def predict(self, view: View) -> DepthPrior:
        """Depth on the network's own grid."""
        tensors, canvas = self._network.run(view)
        return self._depth(view, tensors, canvas)

    def _depth(self, view: View, tensors: dict[str, Float32], canvas: Canvas) -> DepthPrior:
        canonical = self._rule.canonical_focal
        ratio = canvas.focal(view.camera) / canonical if canonical else 1.0
        value = tensors[self._rule.name][..., 0]
        certainty = self._network.description.outputs.confidence
        if certainty is None or certainty.name not in tensors:
            return decode_depth(value, self._rule, ratio)
        return decode_depth(value, self._rule, ratio, tensors[certainty.name][..., 0], certainty)


class OnnxNormals:
    """Normals, with the network's variance if it gives one."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        self._network = Network(options, context)
        self._rule = _normals_rule(self._network.description)

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Normals on the network's own grid; ``depth`` is not used."""
        tensors, _ = self._network.run(view)
        return normals_of(tensors, self._network.description, self._rule, view)


class OnnxJoint(OnnxDepth):
    """Depth and normals in one pass."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._normals_rule = _normals_rule(self._network.description)

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Both priors on the network's own grid."""
        tensors, canvas = self._network.run(view)
        normals = normals_of(tensors, self._network.description, self._normals_rule, view)
        return self._depth(view, tensors, canvas), normals


def normals_of(
    tensors: dict[str, Float32], description: Description, rule: NormalsOutput, view: View
) -> NormalPrior:
    """The normals of a view among a network's output tensors."""
    concentration = description.outputs.kappa
    kappa = tensors[concentration.name][..., concentration.channel] if concentration else None
    return decode_normals(tensors[rule.name], rule, view.camera, kappa)


def _depth_rule(description: Description) -> DepthOutput:
    if description.outputs.depth is None:
        raise ConfigError(f"the network {description.name!r} predicts no depth")
    return description.outputs.depth


def _normals_rule(description: Description) -> NormalsOutput:
    if description.outputs.normals is None:
        raise ConfigError(f"the network {description.name!r} predicts no normals")
    return description.outputs.normals
