"""Metric3D v2 as a provider of depth and normals."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.description import Description, Weights, load_description
from mpsfm_onnx.providers import DescribedJoint, DescribedNormals

from mpsfm_core import ProviderContext
from mpsfm_metric3d_onnx.options import Metric3dOptions


class Metric3dDepth(DescribedJoint):
    """Provider of metric depth and normals from one forward pass of Metric3D."""

    def __init__(self, options: Metric3dOptions, context: ProviderContext) -> None:
        super().__init__(describe(options), context)


class Metric3dNormals(DescribedNormals):
    """Provider of normals and their angular variance from Metric3D."""

    def __init__(self, options: Metric3dOptions, context: ProviderContext) -> None:
        super().__init__(describe(options), context)


def describe(options: Metric3dOptions) -> Description:
    """Return the description of the Metric3D network that the options select."""
    general = load_description(str(Path(__file__).with_name("description.yaml")))
    weights = Weights(uri=options.weights, sha256=options.sha256, companions=options.companions)
    update: dict[str, object] = {"weights": weights}
    if not options.confidence:
        update["outputs"] = general.outputs.model_copy(update={"confidence": None})
    return general.model_copy(update=update)
