"""Providers of depth, normals and a mask that run the compact network."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.description import Description, Weights, load_description
from mpsfm_onnx.network import Network
from mpsfm_onnx.providers import DescribedJoint, DescribedNormals

from mpsfm_compact.options import CompactOptions
from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool
from mpsfm_core.geometry import resize_map


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


def describe(options: CompactOptions) -> Description:
    """Return the compact network's description with the weights and input size of ``options``."""
    general = load_description(str(Path(__file__).with_name("description.yaml")))
    size = general.input.size.model_copy(update={"side": options.size})
    update = {
        "weights": Weights(uri=options.weights, sha256=options.sha256),
        "input": general.input.model_copy(update={"size": size}),
    }
    return general.model_copy(update=update)
