"""What the extraction did, as plain data for ``summary.json``."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, MappingImage, MappingProblem
from mpsfm_core.extraction.backends import ActiveProvider
from mpsfm_core.extraction.matching import Candidates
from mpsfm_core.extraction.verification import TwoView
from mpsfm_core.extraction.workbench import Workbench


def describe(
    bench: Workbench,
    problem: MappingProblem,
    proposed: int,
    candidates: list[Candidates],
    outcomes: list[TwoView],
) -> dict[str, Any]:
    """Pairs, images and providers.

    ``proposed``: number of pairs before the filters of plugins.
    """
    names = bench.images.names
    pairs = [
        _pair(names, matches, outcome)
        for matches, outcome in zip(candidates, outcomes, strict=True)
    ]
    return {
        "pairs_proposed": proposed,
        "pairs_matched": len(candidates),
        "pairs_verified": len(problem.pairs),
        "pairs": pairs,
        "failed": {names[index]: reason for index, reason in sorted(bench.failures.items())},
        "images": {image.name: _image(image) for image in problem.images},
        "providers": [_provider(provider) for provider in bench.providers],
    }


def _pair(names: list[str], matches: Candidates, outcome: TwoView) -> dict[str, Any]:
    a, b = matches.pair
    described: dict[str, Any] = {"images": [names[a], names[b]], "matches": len(matches)}
    if outcome.reason:
        return {**described, "dropped": outcome.reason}
    return {**described, "inliers": len(outcome.inliers), "geometry": outcome.configuration}


def _image(image: MappingImage) -> dict[str, Any]:
    return {
        "keypoints": len(image.keypoints),
        "valid_depth": round(float(image.depth.valid.mean()), 4),
        "median_relative_depth_std": _relative_std(image.depth),
        "valid_normals": round(float(image.normals.valid.mean()), 4),
    }


def _relative_std(depth: DepthPrior) -> float | None:
    if depth.variance is None or not depth.valid.any():
        return None
    std = np.sqrt(depth.variance[depth.valid])
    return round(float(np.median(std / depth.depth[depth.valid])), 5)


def _provider(provider: ActiveProvider) -> dict[str, Any]:
    return {
        "kind": provider.kind,
        "name": provider.spec.name,
        "computed": provider.usage.computed,
        "from_cache": provider.usage.cached,
        "seconds": round(provider.usage.seconds, 3),
    }
