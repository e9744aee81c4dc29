"""DSINE as a provider of normals."""

from __future__ import annotations

from pathlib import Path

from mpsfm_onnx.description import Description, SideSize, load_description
from mpsfm_onnx.providers import DescribedNormals

from mpsfm_core import ProviderContext
from mpsfm_dsine.options import DsineOptions


class Dsine(DescribedNormals):
    """Provider of normals, with a variance computed from the predicted concentration kappa."""

    def __init__(self, options: DsineOptions, context: ProviderContext) -> None:
        super().__init__(describe(options), context, options.model, options.sha256)


def describe(options: DsineOptions) -> Description:
    """Return the description of the DSINE network with the input size of ``options``."""
    general = load_description(str(Path(__file__).with_name("description.yaml")))
    assert isinstance(general.input.size, SideSize)
    size = general.input.size.model_copy(update={"side": options.size})
    return general.model_copy(update={"input": general.input.model_copy(update={"size": size})})
