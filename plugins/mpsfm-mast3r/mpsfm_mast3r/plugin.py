"""Registration of the MASt3R matchers, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.data.options import Options
from mpsfm_core.providers import Capability, ModelExport, weights_from_option
from mpsfm_mast3r.options import DenseOptions, SparseOptions

_LICENSE = "CC-BY-NC-SA-4.0"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register the dense and the sparse MASt3R matcher."""
    return [
        _spec("mast3r", "dense", DenseOptions, "MASt3R: dense matches and depth of both views"),
        _spec("mast3r-sparse", "sparse", SparseOptions, "MASt3R at keypoints of any detector"),
    ]


@hookimpl
def mpsfm_exports() -> dict[str, ModelExport]:
    """Register the ONNX export that runs the code and checkpoint of MASt3R's authors."""
    return {
        "mast3r": ModelExport(
            script="mpsfm_mast3r.export",
            repository="naver/mast3r",
            commit="f5209afc300cec36239a7ac992263f36847bbba0",
            license=_LICENSE,
            packages=("einops", "huggingface-hub"),
        )
    }


def _spec(name: str, how: Capability, options: type[Options], summary: str) -> ProviderSpec:
    return ProviderSpec(
        kind="matcher",
        name=name,
        factory=f"mpsfm_mast3r.matcher:{how.capitalize()}Matcher",
        options=options,
        capabilities=frozenset({how, "pair-depth"}),
        summary=summary,
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-mast3r",
        code_license="Apache-2.0",
        weights_license=_LICENSE,
        weights=weights_from_option("model", WeightsFile("export:mast3r", license=_LICENSE)),
        contract=f"mpsfm_mast3r.contract:{how}",
    )
