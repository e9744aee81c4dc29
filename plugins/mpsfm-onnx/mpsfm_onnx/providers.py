"""Providers of depth and normals from networks in ONNX files.

Other plugins derive their providers from the classes ``Described...``, and pass a description of
their network.
"""

from __future__ import annotations

from mpsfm_core import DepthPrior, NormalPrior, PinholeCamera, ProviderContext, View
from mpsfm_core.data import Bool
from mpsfm_core.data.errors import ConfigError
from mpsfm_onnx.decode import angular_std, decode_depth, decode_normals
from mpsfm_onnx.description import (
    DepthOutput,
    Description,
    NormalsOutput,
    Outputs,
    load_description,
)
from mpsfm_onnx.network import Network, NetworkOutput
from mpsfm_onnx.options import MOGE_2, Moge2Options, OnnxOptions


class DescribedDepth:
    """Provider of depth, with the variance that the network predicts, if any.

    Args:
        weights: Path or URI of the ONNX file. None selects the ONNX file that the network
            description names.
        sha256: Expected SHA-256 hash of the file ``weights``.
    """

    def __init__(
        self,
        description: Description,
        context: ProviderContext,
        weights: str | None = None,
        sha256: str | None = None,
    ) -> None:
        self._rule = _depth_rule(description)
        self._network = Network(description, context, weights, sha256)

    def predict(self, view: View) -> DepthPrior:
        """Predict the depth of a view, at the resolution of the network output."""
        return self._depth(view, self._network.run(view))

    def estimate_focal(self, view: View) -> float | None:
        """Estimate the horizontal focal length of a view in pixels, or return None."""
        if self._rule.assumed_focal is None:
            return None
        answer = self._network.run(view)
        return answer.numbers[self._rule.assumed_focal] * view.camera.width / answer.canvas.image[0]

    def _depth(self, view: View, answer: NetworkOutput) -> DepthPrior:
        rule, outputs = self._rule, self._network.description.outputs
        certainty = outputs.confidence
        std = answer.maps.get(certainty.name) if certainty else None
        return decode_depth(
            answer.maps[rule.name],
            rule,
            view.camera,
            _factor(rule, answer, view.camera),
            None if std is None else std[..., 0],
            certainty,
            _mask(outputs, answer),
        )


class DescribedNormals:
    """Provider of normals, with the variance that the network predicts, if any.

    Args:
        weights: Path or URI of the ONNX file. None selects the ONNX file that the network
            description names.
        sha256: Expected SHA-256 hash of the file ``weights``.
    """

    def __init__(
        self,
        description: Description,
        context: ProviderContext,
        weights: str | None = None,
        sha256: str | None = None,
    ) -> None:
        self._rule = _normals_rule(description)
        self._network = Network(description, context, weights, sha256)

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Predict the normals of a view, at the resolution of the network output."""
        outputs = self._network.description.outputs
        return _normals(view, self._network.run(view), outputs, self._rule)


class DescribedJoint(DescribedDepth):
    """Provider of depth and normals from one forward pass."""

    def __init__(
        self,
        description: Description,
        context: ProviderContext,
        weights: str | None = None,
        sha256: str | None = None,
    ) -> None:
        self._normals_rule = _normals_rule(description)
        super().__init__(description, context, weights, sha256)

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Predict depth and normals of a view, at the resolution of the network output."""
        answer = self._network.run(view)
        outputs = self._network.description.outputs
        return self._depth(view, answer), _normals(view, answer, outputs, self._normals_rule)


class OnnxDepth(DescribedDepth):
    """Provider of depth from the network that the option ``description`` names."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        description = load_description(options.description)
        super().__init__(description, context, options.model, options.sha256)


class Moge2(DescribedJoint):
    """Provider of depth and normals from MoGe-2."""

    def __init__(self, options: Moge2Options, context: ProviderContext) -> None:
        super().__init__(load_description(MOGE_2), context, options.weights, options.sha256)


class Moge2Normals(DescribedNormals):
    """Normals of MoGe-2."""

    def __init__(self, options: Moge2Options, context: ProviderContext) -> None:
        super().__init__(load_description(MOGE_2), context, options.weights, options.sha256)


class OnnxNormals(DescribedNormals):
    """Provider of normals from the network that the option ``description`` names."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        description = load_description(options.description)
        super().__init__(description, context, options.model, options.sha256)


class OnnxJoint(DescribedJoint):
    """Provider of depth and normals from the ONNX network of a YAML description file."""

    def __init__(self, options: OnnxOptions, context: ProviderContext) -> None:
        description = load_description(options.description)
        super().__init__(description, context, options.model, options.sha256)


def _normals(
    view: View, answer: NetworkOutput, outputs: Outputs, rule: NormalsOutput
) -> NormalPrior:
    known = outputs.kappa
    std = angular_std(answer.maps[known.name], known) if known else None
    valid = _mask(outputs, answer)
    return decode_normals(answer.maps[rule.name], rule, view.camera, std, valid)


def _mask(outputs: Outputs, answer: NetworkOutput) -> Bool | None:
    rule = outputs.mask
    return None if rule is None else answer.maps[rule.name][..., 0] > rule.minimum


def _factor(rule: DepthOutput, answer: NetworkOutput, camera: PinholeCamera) -> float:
    """Compute the factor that corrects depth for focal length and predicted metric scale."""
    resized, factor = camera.resized(*answer.canvas.image), 1.0
    if rule.canonical_focal is not None:
        sides = zip(answer.canvas.image, camera.size, strict=True)
        scale = max(
            resized_side / side for resized_side, side in sides
        )  # the shorter side is rounded to whole pixels
        factor *= (camera.fx + camera.fy) / 2 * scale / rule.canonical_focal
    if rule.assumed_focal is not None:
        factor *= resized.fx / answer.numbers[rule.assumed_focal]
    if rule.multiplier is not None:
        factor *= answer.numbers[rule.multiplier]
    return factor


def _depth_rule(description: Description) -> DepthOutput:
    if description.outputs.depth is None:
        raise ConfigError(f"the network {description.name!r} predicts no depth")
    return description.outputs.depth


def _normals_rule(description: Description) -> NormalsOutput:
    if description.outputs.normals is None:
        raise ConfigError(f"the network {description.name!r} predicts no normals")
    return description.outputs.normals
