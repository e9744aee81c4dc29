"""Extraction report with outcomes of pairs, statistics of images and usage of providers."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

from mpsfm_core.data import DepthPrior, MappingImage, MappingProblem
from mpsfm_core.data.decisions import Value
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.match_graph import MatchGraph
from mpsfm_core.extraction.matching.pair_matching import CandidateMatches
from mpsfm_core.extraction.matching.verification import TwoViewGeometry


class PairReport(TypedDict, total=False):
    """Outcome of the geometric verification of an image pair."""

    images: list[str]
    """Names of both images of the pair."""
    matches: int
    """Number of matches of the image pair before verification."""
    inliers: int
    """Number of inlier matches of the two-view geometry of a verified pair."""
    geometry: str
    """COLMAP's configuration of the two-view geometry of a verified pair, such as CALIBRATED."""
    dropped: dict[str, Value]
    """Reason (``PairReason``) why a pair that is not verified was dropped."""


class ImageReport(TypedDict):
    """Statistics of the features and priors of an image."""

    keypoints: int
    adjusted_keypoints: int
    valid_depth: float
    """Ratio of the pixels of the image with a valid depth prior."""
    median_relative_depth_std: float | None
    """Median over the pixels of the depth prior's standard deviation relative to depth."""
    valid_normals: float
    """Ratio of the pixels of the image with a valid normal prior."""


class ProviderReport(TypedDict):
    """Usage of a provider during extraction."""

    kind: str
    name: str
    computed: int
    """Number of results that the provider computed in this run."""
    from_cache: int
    """Number of results of the provider that were read from the cache."""
    seconds: float
    """Time of all calls of the provider in seconds."""


class ExtractionReport(TypedDict):
    """Report of the extraction of features, matches and priors for ``summary.json``."""

    pairs_proposed: int
    """Number of selected image pairs before plugins filter the pairs."""
    pairs_matched: int
    pairs_verified: int
    pairs: list[PairReport]
    """Outcome of each matched image pair."""
    failed: dict[str, str]
    """Error message of a provider that failed on an image, by image name."""
    images: dict[str, ImageReport]
    """Statistics of each image, by image name."""
    providers: list[ProviderReport]


def describe(
    context: ExtractionContext,
    problem: MappingProblem,
    graph: MatchGraph,
) -> ExtractionReport:
    """Describe image pairs, images and providers of an extraction.

    Args:
        context: Context of the extraction with images, failures and providers.
        problem: Input of the mapper with images and verified pairs.
        graph: Match graph with matches and two-view geometries of all matched pairs.
    """
    names = context.images.names
    pairs = [
        _pair(names, matches, outcome, context.config.verification.min_inliers)
        for matches, outcome in zip(graph.candidates, graph.geometries, strict=True)
    ]
    return {
        "pairs_proposed": graph.num_proposed,
        "pairs_matched": len(graph.candidates),
        "pairs_verified": len(problem.distinct_pairs),
        "pairs": pairs,
        "failed": {names[index]: reason for index, reason in sorted(context.failures.items())},
        "images": {image.name: _image(image) for image in problem.images},
        "providers": [_provider(provider) for provider in context.providers],
    }


def merge_reports(first: ExtractionReport, second: ExtractionReport) -> ExtractionReport:
    """Merge the reports of the first and second extraction pass."""
    pairs = {tuple(pair["images"]): pair for pair in first["pairs"]}
    for pair in second["pairs"]:
        images = tuple(pair["images"])
        pairs[images] = _merge_pair(pairs.get(images, pair), pair)
    used = {(provider["kind"], provider["name"]) for provider in second["providers"]}
    return {
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


def _merge_pair(first: PairReport, second: PairReport) -> PairReport:
    """Merge two reports of an image pair; a verified result replaces a dropped one."""
    if first is second or "dropped" in first:
        return second
    if "dropped" in second:
        return first
    best = max(first, second, key=lambda pair: pair["inliers"])
    num_inliers = first["inliers"] + second["inliers"]
    return {**best, "matches": first["matches"] + second["matches"], "inliers": num_inliers}


def _pair(
    names: list[str], matches: CandidateMatches, outcome: TwoViewGeometry, min_matches: int
) -> PairReport:
    a, b = matches.pair
    described: PairReport = {"images": [names[a], names[b]], "matches": len(matches)}
    if outcome.dropped:
        reason = outcome.drop_reason(len(matches), min_matches)
        return {**described, "dropped": reason.to_json()}
    return {**described, "inliers": len(outcome.inliers), "geometry": outcome.configuration}


def _image(image: MappingImage) -> ImageReport:
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


def _provider(provider: ActiveProvider) -> ProviderReport:
    return {
        "kind": provider.kind,
        "name": provider.spec.name,
        "computed": provider.usage.computed,
        "from_cache": provider.usage.cached,
        "seconds": round(provider.usage.seconds, 3),
    }
