"""Registration of the Hub providers, importing neither torch nor transformers."""

from __future__ import annotations

from pydantic import BaseModel

from mpsfm_core import Options, ProviderSpec, hookimpl
from mpsfm_core.providers import Capability, Kind
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_transformers import options as opt

_OF_THE_MODEL = "of the chosen model"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register providers of depth, features, matches and global descriptors."""
    return [
        _spec(
            "depth",
            "transformers",
            "depth:HubDepth",
            opt.DepthOptions,
            "any depth model of the Hub: Depth Anything V2, Depth Pro, ZoeDepth, DPT ...",
            _OF_THE_MODEL,
            "intrinsics-aware",
            "estimates-focal",
        ),
        _spec(
            "depth",
            "prompt-depth-anything",
            "depth:PromptDepth",
            opt.PromptOptions,
            "Prompt Depth Anything: refines the depth maps of a sensor",
            _OF_THE_MODEL,
            "metric",
            "uncached",
        ),
        _spec(
            "features",
            "superpoint-hub",
            "features:SuperPointFeatures",
            opt.SuperPointOptions,
            "SuperPoint: learned corners",
            tags=("superpoint",),
        ),
        _spec(
            "matcher",
            "lightglue-superpoint-hub",
            "sparse:LightGlueMatcher",
            opt.LightGlueOptions,
            "LightGlue: learned matching of SuperPoint",
            None,
            "sparse",
            tags=("superpoint",),
        ),
        _spec(
            "matcher",
            "superglue",
            "sparse:SuperGlueMatcher",
            opt.SuperGlueOptions,
            "SuperGlue: learned matching of SuperPoint",
            None,
            "sparse",
            tags=("superpoint",),
        ),
        _spec(
            "matcher",
            "efficient-loftr",
            "loftr:EfficientLoftrMatcher",
            opt.EfficientLoftrOptions,
            "Efficient LoFTR: semi-dense matches without a detector",
            None,
            "dense",
        ),
        _spec(
            "retrieval",
            "dino",
            "retrieval:Dino",
            opt.DinoOptions,
            "global descriptor of DINOv2 or DINOv3",
            _OF_THE_MODEL,
        ),
    ]


@hookimpl
def mpsfm_calibration(
    kind: str, provider: str, options: BaseModel | None
) -> DepthCalibration | NormalCalibration | None:
    """Return the calibration of the depth model that the options select."""
    if isinstance(options, opt.PromptOptions):
        return opt.METRIC
    if isinstance(options, opt.DepthOptions):
        entry = opt.look_up_model(options.model)
        unsaid = entry.pattern == "*" and options.metric
        return opt.METRIC if unsaid else entry.calibration
    return None


def _spec(
    kind: Kind,
    name: str,
    factory: str,
    options: type[opt.HubOptions],
    summary: str,
    weights_license: str | None = None,
    *capabilities: Capability,
    tags: tuple[str, ...] = (),
) -> ProviderSpec:
    model: str = options.model_fields["model"].default
    accepted: type[Options] = options
    return ProviderSpec(
        kind=kind,
        name=name,
        factory=f"mpsfm_transformers.{factory}",
        contract=f"mpsfm_transformers.contract:{name.replace('-', '_')}",
        options=accepted,
        capabilities=frozenset(capabilities),
        summary=summary,
        requires=("torch", "transformers"),
        install_hint="pip install mpsfm-transformers",
        code_license="Apache-2.0",
        weights_license=weights_license or opt.look_up_model(model).license,
        weights=opt.hub_files,
        accuracy=_OF_THE_MODEL,
        tags=tags,
    )
