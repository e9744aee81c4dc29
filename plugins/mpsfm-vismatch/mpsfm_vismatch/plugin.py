"""Registration of the vismatch providers, importing neither torch nor vismatch."""

from __future__ import annotations

from mpsfm_core import Options, ProviderSpec, hookimpl
from mpsfm_core.providers import Capability
from mpsfm_vismatch import options as opt


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register vismatch matchers of any network, of RoMa and of MASt3R."""
    unknown, roma, mast3r = "of the chosen network", "MIT", "CC-BY-NC-SA-4.0"
    return [
        _spec("vismatch", "matcher", opt.CollectionOptions, "any matcher of vismatch", unknown),
        _spec(
            "vismatch-sparse",
            "matcher",
            opt.SnapOptions,
            "any matcher of vismatch, at keypoints of any detector",
            unknown,
        ),
        _spec("vismatch-roma", "roma", opt.RomaDenseOptions, "RoMa in torch", roma),
        _spec(
            "vismatch-roma-sparse",
            "roma",
            opt.RomaSparseOptions,
            "RoMa in torch, at keypoints of any detector",
            roma,
        ),
        _spec(
            "vismatch-mast3r",
            "mast3r",
            opt.Mast3rDenseOptions,
            "MASt3R in torch: dense matches and depth of both views",
            mast3r,
            "pair-depth",
        ),
        _spec(
            "vismatch-mast3r-sparse",
            "mast3r",
            opt.Mast3rSparseOptions,
            "MASt3R in torch, at keypoints of any detector",
            mast3r,
            "pair-depth",
        ),
    ]


def _spec(
    name: str,
    module: str,
    options: type[Options],
    summary: str,
    weights_license: str,
    *capabilities: Capability,
) -> ProviderSpec:
    how: Capability = "sparse" if name.endswith("-sparse") else "dense"
    return ProviderSpec(
        kind="matcher",
        name=name,
        factory=f"mpsfm_vismatch.{module}:{how.capitalize()}Matcher",
        options=options,
        capabilities=frozenset({how, *capabilities}),
        summary=summary,
        requires=("torch", "vismatch"),
        install_hint="mpsfm env create vismatch mpsfm-vismatch vismatch",
        code_license="Apache-2.0",
        weights_license=weights_license,
        contract=f"mpsfm_vismatch.contract:{name.replace('-', '_')}",
    )
