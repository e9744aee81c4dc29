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
from mpsfm_core.data.options import FROM_MULTIVIEW
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import ExtractionEvents, NullExtractionEvents
from mpsfm_core.extraction.execution import workers_elsewhere
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.matching.dense_matches import NO_POINTS
from mpsfm_core.extraction.matching.matching import (
    Candidates,
    PairMatcher,
    PairVerifier,
    adjusted,
    adjusted_problem,
    assemble,
    joined,
)
from mpsfm_core.extraction.matching.verification import TwoView
from mpsfm_core.extraction.pairs.selection import PairSelection
from mpsfm_core.extraction.priors.multiview import GroupPriors
from mpsfm_core.extraction.priors.predictions import Predictions, check_depth_source
from mpsfm_core.extraction.report import describe, describe_both
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.matches import ImportedMatches
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
    bench = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with (
        threadpool_limits(thread_count(config.runtime), user_api="blas"),
        workers_elsewhere(bench),
    ):
        return _extract(bench, imported)


def extract_more(
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
    bench = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with (
        threadpool_limits(thread_count(config.runtime), user_api="blas"),
        workers_elsewhere(bench),
    ):
        bench.run_masks()
        found = _match(bench, loose, first.problem.pairs)
        assembled = assemble(found.candidates, found.outcomes, found.located)
        assembled = adjusted(bench, assembled)
    problem = joined(first.problem, assembled)
    more = describe(bench, problem, found.proposed, found.candidates, found.outcomes)
    return Extraction(problem, describe_both(first.report, more))


def adjust(
    images: ImageSet, config: Config, registry: Registry, problem: MappingProblem
) -> MappingProblem:
    """The problem of an extraction without adjustment, or a part of its pairs, with adjusted
    keypoints. Raises as :func:`extract`."""
    bench = ExtractionContext(images, config, registry, NullExtractionEvents())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        return adjusted_problem(bench, problem)


def _extract(bench: ExtractionContext, imported: ImportedMatches | None) -> Extraction:
    check_depth_source(bench.config, bench.registry)
    bench.run_masks()
    found = _match(bench) if imported is None else _verify(bench, imported)
    candidates, outcomes, located = found.candidates, found.outcomes, found.located
    assembled = assemble(candidates, outcomes, located)
    if imported is None:
        assembled = adjusted(bench, assembled)
    groups = _see_groups(bench, assembled.pairs)
    priors = Predictions(bench, found.matcher, candidates, groups).run()
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
                **_place(bench, groups, index),
            )
            for index, image in enumerate(bench.images)
        ),
        assembled.pairs,
    )
    described = describe(bench, problem, found.proposed, candidates, outcomes)
    if groups is not None:
        described["groups"] = groups.described()
    return Extraction(problem, described)


def _see_groups(bench: ExtractionContext, pairs: tuple[VerifiedPair, ...]) -> GroupPriors | None:
    """Show the multi-view network, where there is one, groups of photos that see the same."""
    if bench.config.multiview is None:
        return None
    groups = GroupPriors(bench)
    groups.run({(pair.image_a, pair.image_b): len(pair) for pair in pairs})
    return groups


def _place(bench: ExtractionContext, groups: GroupPriors | None, index: int) -> dict[str, Any]:
    """What the mapper is told of an image's group, if its depth is the group's."""
    if groups is None or bench.config.depth.use != FROM_MULTIVIEW:
        return {}
    group, pose = groups.place(index)
    return {"depth_group": group, "proposed_pose": pose}


@dataclass(frozen=True, eq=False)
class _Found:
    """``located``: features of the images, without descriptors. ``proposed``: number of pairs
    before the filters of plugins. ``outcomes``: of each of the ``candidates``."""

    located: list[Features]
    proposed: int
    candidates: list[Candidates]
    outcomes: list[TwoView]
    matcher: PairMatcher | None = None


def _match(
    bench: ExtractionContext,
    loose: Collection[int] | None = None,
    verified: Sequence[VerifiedPair] = (),
) -> _Found:
    """By the providers of the configuration; pairs of ``loose`` images, all if None, beside those
    that are ``verified`` already."""
    backend = bench.config.features
    table = None if backend is None else FeatureTable(bench, backend)
    located = [_NO_FEATURES] * len(bench.images) if table is None else table.extract()
    selection = PairSelection(bench, table, loose)
    matcher, verifier = PairMatcher(bench, table), PairVerifier(bench, located)
    candidates = matcher.match(selection.choose(), located)
    outcomes = verifier.verify(candidates)
    kept = zip(candidates, outcomes, strict=True)
    connected = [(pair.image_a, pair.image_b) for pair in verified]
    connected += [c.pair for c, outcome in kept if not outcome.reason]
    if more := selection.choose_again(connected):
        candidates += matcher.match(more, located)
        outcomes += verifier.verify(candidates[len(outcomes) :])
    return _Found(located, selection.proposed, candidates, outcomes, matcher)


def _verify(bench: ExtractionContext, imported: ImportedMatches) -> _Found:
    """As they come, without those in masked areas."""
    located, allowed = [], []
    for index, (xy, std_px) in enumerate(zip(imported.keypoints, imported.std_px, strict=True)):
        mask = bench.mask(index)
        allowed.append(np.ones(len(xy), np.bool_) if mask is None else sample_nearest(mask, xy))
        located.append(Features(xy, np.empty((len(xy), 0), dtype=np.float32), std_px=std_px))
    candidates = []
    for pair, matches in sorted(imported.matches.items()):
        keep = allowed[pair[0]][matches.indices[:, 0]] & allowed[pair[1]][matches.indices[:, 1]]
        sparse = SparseMatches(matches.indices[keep], matches.scores[keep])
        candidates.append(Candidates(pair, sparse, NO_POINTS, 1.0))
    outcomes = PairVerifier(bench, located).verify(candidates)
    return _Found(located, len(candidates), candidates, outcomes)


_NO_FEATURES = Features(np.empty((0, 2)), np.empty((0, 0), dtype=np.float32))
