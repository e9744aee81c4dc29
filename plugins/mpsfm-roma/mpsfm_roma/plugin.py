"""Registration of the RoMa matchers, importing neither onnxruntime nor OpenCV."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.data.options import Options
from mpsfm_core.providers import Capability, weights_from_option
from mpsfm_roma.options import DenseOptions, SparseOptions


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register the dense and the sparse RoMa matcher."""
    return [
        _spec("roma", "dense", DenseOptions, "RoMa: dense matches of a warp"),
        _spec("roma-sparse", "sparse", SparseOptions, "RoMa's warp at keypoints of any detector"),
    ]


def _spec(name: str, how: Capability, options: type[Options], summary: str) -> ProviderSpec:
    return ProviderSpec(
        kind="matcher",
        name=name,
        factory=f"mpsfm_roma.matcher:{how.capitalize()}Matcher",
        options=options,
        capabilities=frozenset({how}),
        summary=summary,
        requires=("onnxruntime",),
        install_hint="pip install mpsfm-roma",
        code_license="Apache-2.0",
        weights_license="MIT",
        weights=weights_from_option("model"),
        contract=f"mpsfm_roma.contract:{how}",
    )
