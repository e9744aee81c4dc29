"""Extraction section of ``summary.json``: pairs, images and providers, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, MappingImage, MappingProblem
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.match_graph import MatchGraph
from mpsfm_core.extraction.matching.pair_matching import CandidateMatches
from mpsfm_core.extraction.matching.verification import TwoViewGeometry


def describe(
    context: ExtractionContext,
    problem: MappingProblem,
    graph: MatchGraph,
) -> dict[str, Any]:
    """Describe pairs, images and providers of an extraction as plain data.

    Args:
        context: Context of the extraction with images, failures and providers.
        problem: Input of the mapper with images and verified pairs.
        graph: Candidate matches and two-view geometries of all matched pairs.
    """
    names = context.images.names
    pairs = [
        _pair(names, matches, outcome, context.config.verification.min_inliers)
        for matches, outcome in zip(graph.candidates, graph.geometries, strict=True)
    ]
    return {
        "pairs_proposed": graph.num_proposed,
        "pairs_matched": len(graph.candidates),
        "pairs_verified": len(problem.pairs),
        "pairs": pairs,
        "failed": {names[index]: reason for index, reason in sorted(context.failures.items())},
        "images": {image.name: _image(image) for image in problem.images},
        "providers": [_provider(provider) for provider in context.providers],
    }


def merge_reports(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the reports of the first and second extraction pass."""
    pairs = {tuple(pair["images"]): pair for pair in first["pairs"]}
    for pair in second["pairs"]:
        images = tuple(pair["images"])
        pairs[images] = _merge_pair(pairs.get(images, pair), pair)
    used = {(provider["kind"], provider["name"]) for provider in second["providers"]}
    return {
        **first,
        "pairs_proposed": first["pairs_proposed"] + second["pairs_proposed"],
        "pairs_matched": first["pairs_matched"] + second["pairs_matched"],
        "pairs_verified": second["pairs_verified"],
        "pairs": [pairs[images] for images in sorted(pairs)],
        "failed": {**first["failed"], **second["failed"]},
        "images": second["images"],
        "providers": [
            *(p for p in first["providers"] if (p["kind"], p["name"]) not in used),
            *second["providers"],
        ],
    }


def _merge_pair(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Merge two reports of an image pair; a verified result replaces a dropped one."""
    if first is second or "dropped" in first:
        return second
    if "dropped" in second:
        return first
    best = max(first, second, key=lambda pair: pair["inliers"])
    return {**best, **{key: first[key] + second[key] for key in ("matches", "inliers")}}


def _pair(
    names: list[str], matches: CandidateMatches, outcome: TwoViewGeometry, min_matches: int
) -> dict[str, Any]:
    a, b = matches.pair
    described: dict[str, Any] = {"images": [names[a], names[b]], "matches": len(matches)}
    if outcome.dropped:
        reason = outcome.drop_reason(len(matches), min_matches)
        return {**described, "dropped": reason.to_json()}
    return {**described, "inliers": len(outcome.inliers), "geometry": outcome.configuration}


def _image(image: MappingImage) -> dict[str, Any]:
    return {
        "keypoints": len(image.keypoints),
        "adjusted_keypoints": _num_adjusted(image),
        "valid_depth": round(float(image.depth.valid.mean()), 4),
        "median_relative_depth_std": _relative_std(image.depth),
        "valid_normals": round(float(image.normals.valid.mean()), 4),
    }


def _num_adjusted(image: MappingImage) -> int:
    factor = image.keypoint_std_factor
    return 0 if factor is None else int((factor < 1).sum())


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
