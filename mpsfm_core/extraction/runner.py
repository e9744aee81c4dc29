"""Run the configured providers on all images, and assemble the input of the mapper.

The stages run in the order masks, features, image similarity, matching, verification, matching and
verification of further pairs between components, keypoint adjustment, multi-view networks, depth,
and normals. Provider results are validated before they are cached. Calibration and resizing are
applied to cached results, so changing their options runs no network again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.config import Config
from mpsfm_core.data import Features, MappingImage, MappingProblem, SparseMatches, VerifiedPair
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import ExtractionEvents, NullExtractionEvents
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.matching.dense_matches import NO_POINTS
from mpsfm_core.extraction.matching.pair_matching import (
    CandidateMatches,
    PairMatcher,
    PairVerifier,
    adjust_assembled,
    adjust_problem_keypoints,
    assemble_matches,
    merge_matches,
)
from mpsfm_core.extraction.matching.verification import TwoViewGeometry
from mpsfm_core.extraction.pairs.selection import PairSelection
from mpsfm_core.extraction.priors.multiview import GroupPriors
from mpsfm_core.extraction.priors.prior_predictor import PriorPredictor, check_depth_source
from mpsfm_core.extraction.remote_execution import use_executor
from mpsfm_core.extraction.report import describe, merge_reports
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.matches import ImportedMatches
from mpsfm_core.providers.provider_config import FROM_MULTIVIEW
from mpsfm_core.providers.registry import Registry


@dataclass(frozen=True, eq=False)
class Extraction:
    """Result of extraction."""

    problem: MappingProblem
    """Input of the mapper, with the images in the order of the image set."""
    report: dict[str, Any]
    """Plain data for ``summary.json``: matched and dropped pairs, and the usage of providers."""


def extract(
    images: ImageSet,
    config: Config,
    registry: Registry,
    events: ExtractionEvents | None = None,
    imported: ImportedMatches | None = None,
) -> Extraction:
    """Run all providers of a configuration on a set of images.

    Cached results are not computed again, so an interrupted run continues where it stopped.

    Args:
        images: The images.
        config: Configuration in which each block has one available provider.
        registry: The installed providers.
        events: Receives progress.
        imported: Imported keypoints and matches, which are verified and replace feature extraction,
            pair selection and matching.

    Returns:
        The input of the mapper and the extraction report.

    Raises:
        InputError: a provider, its weights or its files are missing, or the configured providers
            are incompatible.
        ProviderRunError: a provider failed on an image.
        ProviderOutputError: the output of a provider violates the provider contract.
        ConfigError: the executor is unavailable, or its workers do not share the cache.
        OutputError: the cache cannot be written.
    """
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with (
        threadpool_limits(thread_count(config.runtime), user_api="blas"),
        use_executor(context),
    ):
        return _extract(context, imported)


def extend_matches(
    images: ImageSet,
    config: Config,
    registry: Registry,
    first: Extraction,
    unconstrained: Collection[int],
    events: ExtractionEvents | None = None,
) -> Extraction:
    """Extend the extraction of a fast first pass by matches of unconstrained images.

    Depth and normals of the first pass are reused. Raises the same errors as :func:`extract`.

    Args:
        images: The images.
        config: Configuration with the feature provider and matchers of the second pass.
        registry: The installed providers.
        first: Extraction result of the fast first pass.
        unconstrained: Indices of the images to match again; each new pair contains at least one of
            these images.
        events: Receives progress.
    """
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with (
        threadpool_limits(thread_count(config.runtime), user_api="blas"),
        use_executor(context),
    ):
        context.run_masks()
        outcome = _match(context, unconstrained, first.problem.pairs)
        assembled = assemble_matches(outcome.candidates, outcome.geometries, outcome.located)
        assembled = adjust_assembled(context, assembled)
    problem = merge_matches(first.problem, assembled)
    second = describe(context, problem, outcome.proposed, outcome.candidates, outcome.geometries)
    return Extraction(problem, merge_reports(first.report, second))


def adjust_problem(
    images: ImageSet, config: Config, registry: Registry, problem: MappingProblem
) -> MappingProblem:
    """Adjust the keypoints of a mapping problem that was extracted without adjustment.

    Raises the same errors as :func:`extract`.

    Args:
        images: The images.
        config: Configuration with the options of keypoint adjustment.
        registry: The installed providers.
        problem: Mapping problem to adjust, with all or a part of its image pairs.
    """
    context = ExtractionContext(images, config, registry, NullExtractionEvents())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        return adjust_problem_keypoints(context, problem)


def _extract(context: ExtractionContext, imported: ImportedMatches | None) -> Extraction:
    check_depth_source(context.config, context.registry)
    context.run_masks()
    outcome = _match(context) if imported is None else _verify_imported(context, imported)
    candidates = outcome.candidates
    assembled = assemble_matches(candidates, outcome.geometries, outcome.located)
    if imported is None:
        assembled = adjust_assembled(context, assembled)
    groups = _predict_groups(context, assembled.pairs)
    priors = PriorPredictor(context, outcome.matcher, candidates, groups).run()
    problem = MappingProblem(
        tuple(
            MappingImage(
                image.name,
                image.pinhole,
                assembled.keypoints[index],
                *priors[index],
                keypoint_std_px=assembled.std_px[index],
                keypoint_std_factor=assembled.std_factor[index],
                focal_known=image.focal_known,
                focal_log_std=image.focal_log_std,
                **_group_fields(context, groups, index),
            )
            for index, image in enumerate(context.images)
        ),
        assembled.pairs,
    )
    described = describe(context, problem, outcome.proposed, candidates, outcome.geometries)
    if groups is not None:
        described["groups"] = groups.described()
    return Extraction(problem, described)


def _predict_groups(
    context: ExtractionContext, pairs: tuple[VerifiedPair, ...]
) -> GroupPriors | None:
    """Run the multi-view network, if configured, on groups of images that share matches."""
    if context.config.multiview is None:
        return None
    groups = GroupPriors(context)
    groups.run({(pair.image_a, pair.image_b): len(pair) for pair in pairs})
    return groups


def _group_fields(
    context: ExtractionContext, groups: GroupPriors | None, index: int
) -> dict[str, Any]:
    """Return the group and the proposed pose of an image whose depth is predicted in groups."""
    if groups is None or context.config.depth.use != FROM_MULTIVIEW:
        return {}
    group, pose = groups.place(index)
    return {"depth_group": group, "proposed_pose": pose}


@dataclass(frozen=True, eq=False)
class MatchingOutcome:
    """Matches of all pairs with their two-view geometries."""

    located: list[Features]
    """Features of the images, without descriptors."""
    proposed: int
    """Number of selected pairs before plugins filter the pairs."""
    candidates: list[CandidateMatches]
    geometries: list[TwoViewGeometry]
    """Two-view geometry of the candidate matches of each pair."""
    matcher: PairMatcher | None = None


def _match(
    context: ExtractionContext,
    unconstrained: Collection[int] | None = None,
    verified: Sequence[VerifiedPair] = (),
) -> MatchingOutcome:
    """Select, match and verify pairs with the configured providers.

    Args:
        context: The run.
        unconstrained: Indices of images of which each pair contains at least one; if None, all
            pairs are allowed.
        verified: Pairs that an earlier pass verified, which connect components.
    """
    features = context.config.features
    table = None if features is None else FeatureTable(context, features)
    located = [_NO_FEATURES] * len(context.images) if table is None else table.extract()
    selection = PairSelection(context, table, unconstrained)
    matcher, verifier = PairMatcher(context, table), PairVerifier(context, located)
    candidates = matcher.match(selection.choose(), located)
    geometries = verifier.verify(candidates)
    pairs_with_geometry = zip(candidates, geometries, strict=True)
    connected = [(pair.image_a, pair.image_b) for pair in verified]
    connected += [c.pair for c, geometry in pairs_with_geometry if not geometry.dropped]
    if further_pairs := selection.choose_again(connected):
        candidates += matcher.match(further_pairs, located)
        geometries += verifier.verify(candidates[len(geometries) :])
    return MatchingOutcome(located, selection.proposed, candidates, geometries, matcher)


def _verify_imported(context: ExtractionContext, imported: ImportedMatches) -> MatchingOutcome:
    """Verify imported matches, after removing matches in masked areas."""
    located, allowed = [], []
    for index, (xy, std_px) in enumerate(zip(imported.keypoints, imported.std_px, strict=True)):
        mask = context.mask(index)
        allowed.append(np.ones(len(xy), np.bool_) if mask is None else sample_nearest(mask, xy))
        located.append(Features(xy, np.empty((len(xy), 0), dtype=np.float32), std_px=std_px))
    candidates = []
    for pair, matches in sorted(imported.matches.items()):
        keep = allowed[pair[0]][matches.indices[:, 0]] & allowed[pair[1]][matches.indices[:, 1]]
        sparse = SparseMatches(matches.indices[keep], matches.scores[keep])
        candidates.append(CandidateMatches(pair, sparse, NO_POINTS, 1.0))
    geometries = PairVerifier(context, located).verify(candidates)
    return MatchingOutcome(located, len(candidates), candidates, geometries)


_NO_FEATURES = Features(np.empty((0, 2)), np.empty((0, 0), dtype=np.float32))
