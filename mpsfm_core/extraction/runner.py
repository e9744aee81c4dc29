"""Runs the chosen providers over the images and assembles the mapper's problem.

Order: masks, features, first look or retrieval, matching, verification (both again where photos
stay apart), adjustment of keypoints, groups of photos for a multi-view network, depth, normals.
Whatever a provider returns is validated, then cached; calibration and resizing come after the
cache, so that a change of them predicts nothing anew.
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
from mpsfm_core.extraction.report import describe, describe_both
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.matches import ImportedMatches
from mpsfm_core.providers.provider_config import FROM_MULTIVIEW
from mpsfm_core.providers.registry import Registry


@dataclass(frozen=True, eq=False)
class Extraction:
    """The mapper's problem, its images in the order of the image set, and a report.

    ``report`` is plain data for ``summary.json``: pairs tried and dropped with reasons, and what
    each provider did.
    """

    problem: MappingProblem
    report: dict[str, Any]


def extract(
    images: ImageSet,
    config: Config,
    registry: Registry,
    events: ExtractionEvents | None = None,
    imported: ImportedMatches | None = None,
) -> Extraction:
    """Run all providers of a configuration.

    What the cache has is not computed again, so that an interrupted run goes on where it was.
    ``imported``: keypoints and matches that stand instead of features, pairs and matchers; they are
    verified as ours are.

    Raises:
        InputError: a provider, its weights or its files are missing, or the configuration does
            not fit together.
        ProviderRunError, ProviderOutputError: a provider failed or broke its contract.
        ConfigError: the executor cannot be had, or its workers do not share the cache.
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
    loose: Collection[int],
    events: ExtractionEvents | None = None,
) -> Extraction:
    """A finished extraction, with further matches of the pairs that one of the ``loose`` images is
    in, by the features and matchers of ``config``.

    Depth and normals stay. Raises as :func:`extract`.
    """
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with (
        threadpool_limits(thread_count(config.runtime), user_api="blas"),
        use_executor(context),
    ):
        context.run_masks()
        found = _match(context, loose, first.problem.pairs)
        assembled = assemble_matches(found.candidates, found.outcomes, found.located)
        assembled = adjust_assembled(context, assembled)
    problem = merge_matches(first.problem, assembled)
    more = describe(context, problem, found.proposed, found.candidates, found.outcomes)
    return Extraction(problem, describe_both(first.report, more))


def adjust_problem(
    images: ImageSet, config: Config, registry: Registry, problem: MappingProblem
) -> MappingProblem:
    """The problem of an extraction without adjustment, or a part of its pairs, with adjust_assembled
    keypoints. Raises as :func:`extract`."""
    context = ExtractionContext(images, config, registry, NullExtractionEvents())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        return adjust_problem_keypoints(context, problem)


def _extract(context: ExtractionContext, imported: ImportedMatches | None) -> Extraction:
    check_depth_source(context.config, context.registry)
    context.run_masks()
    found = _match(context) if imported is None else _verify(context, imported)
    candidates, outcomes, located = found.candidates, found.outcomes, found.located
    assembled = assemble_matches(candidates, outcomes, located)
    if imported is None:
        assembled = adjust_assembled(context, assembled)
    groups = _see_groups(context, assembled.pairs)
    priors = PriorPredictor(context, found.matcher, candidates, groups).run()
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
                **_place(context, groups, index),
            )
            for index, image in enumerate(context.images)
        ),
        assembled.pairs,
    )
    described = describe(context, problem, found.proposed, candidates, outcomes)
    if groups is not None:
        described["groups"] = groups.described()
    return Extraction(problem, described)


def _see_groups(context: ExtractionContext, pairs: tuple[VerifiedPair, ...]) -> GroupPriors | None:
    """Show the multi-view network, where there is one, groups of photos that see the same."""
    if context.config.multiview is None:
        return None
    groups = GroupPriors(context)
    groups.run({(pair.image_a, pair.image_b): len(pair) for pair in pairs})
    return groups


def _place(context: ExtractionContext, groups: GroupPriors | None, index: int) -> dict[str, Any]:
    """What the mapper is told of an image's group, if its depth is the group's."""
    if groups is None or context.config.depth.use != FROM_MULTIVIEW:
        return {}
    group, pose = groups.place(index)
    return {"depth_group": group, "proposed_pose": pose}


@dataclass(frozen=True, eq=False)
class MatchingOutcome:
    """``located``: features of the images, without descriptors. ``proposed``: number of pairs
    before the filters of plugins. ``outcomes``: of each of the ``candidates``."""

    located: list[Features]
    proposed: int
    candidates: list[CandidateMatches]
    outcomes: list[TwoViewGeometry]
    matcher: PairMatcher | None = None


def _match(
    context: ExtractionContext,
    loose: Collection[int] | None = None,
    verified: Sequence[VerifiedPair] = (),
) -> MatchingOutcome:
    """By the providers of the configuration; pairs of ``loose`` images, all if None, beside those
    that are ``verified`` already."""
    backend = context.config.features
    table = None if backend is None else FeatureTable(context, backend)
    located = [_NO_FEATURES] * len(context.images) if table is None else table.extract()
    selection = PairSelection(context, table, loose)
    matcher, verifier = PairMatcher(context, table), PairVerifier(context, located)
    candidates = matcher.match(selection.choose(), located)
    outcomes = verifier.verify(candidates)
    kept = zip(candidates, outcomes, strict=True)
    connected = [(pair.image_a, pair.image_b) for pair in verified]
    connected += [c.pair for c, outcome in kept if not outcome.dropped]
    if more := selection.choose_again(connected):
        candidates += matcher.match(more, located)
        outcomes += verifier.verify(candidates[len(outcomes) :])
    return MatchingOutcome(located, selection.proposed, candidates, outcomes, matcher)


def _verify(context: ExtractionContext, imported: ImportedMatches) -> MatchingOutcome:
    """As they come, without those in masked areas."""
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
    outcomes = PairVerifier(context, located).verify(candidates)
    return MatchingOutcome(located, len(candidates), candidates, outcomes)


_NO_FEATURES = Features(np.empty((0, 2)), np.empty((0, 0), dtype=np.float32))
