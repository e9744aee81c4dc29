"""Run the configured providers on all images, and assemble the input of the mapper.

The stages run in the order masks, features, image similarity, matching, verification, matching and
verification of further pairs between components, keypoint adjustment, multi-view networks, depth,
and normals. Provider results are validated before they are cached. Calibration and resizing are
applied to cached results, so changing their options runs no network again.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.config import Config
from mpsfm_core.data import Features, MappingImage, MappingProblem, SparseMatches, VerifiedPair
from mpsfm_core.data.decisions import Reason
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.duplicates import find_duplicates
from mpsfm_core.extraction.events import ExtractionEvents, NullExtractionEvents
from mpsfm_core.extraction.features import (
    NO_FEATURES,
    FeatureSet,
    FeatureSource,
    FeatureTable,
    SharedFeatures,
)
from mpsfm_core.extraction.match_graph import MatchGraph, Priors
from mpsfm_core.extraction.matching.dense_matches import NO_POINTS
from mpsfm_core.extraction.matching.pair_matching import (
    AssembledMatches,
    CandidateMatches,
    PairMatcher,
    PairVerifier,
    add_duplicates,
    adjust_assembled,
    adjust_problem_keypoints,
    assemble_matches,
    merge_matches,
)
from mpsfm_core.extraction.output_checks import find_wrong_providers
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.extraction.pairs.selection import PairSelection
from mpsfm_core.extraction.priors.multiview import GroupPriors
from mpsfm_core.extraction.priors.prior_predictor import PriorPredictor, check_depth_source
from mpsfm_core.extraction.remote_execution import use_executor
from mpsfm_core.extraction.report import ExtractionReport, describe, merge_reports
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.matches import ImportedMatches
from mpsfm_core.providers.provider_config import FROM_MULTIVIEW
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.memory import release_free_memory


@dataclass(frozen=True, eq=False)
class Extraction:
    """Result of extraction."""

    problem: MappingProblem
    """Input of the mapper, with the images in the order of the image set."""
    report: ExtractionReport
    """Outcomes of image pairs, statistics of images and usage of providers for ``summary.json``."""
    doubts: tuple[Reason, ...] = ()
    """Reasons (``DoubtReason``) to doubt the output of a provider for all images or pairs."""


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
    with extraction_environment(context):
        return _extract(context, imported)


@contextmanager
def extraction_environment(context: ExtractionContext) -> Iterator[None]:
    """Limit the threads of BLAS and use the configured executor inside a ``with`` block.

    The memory of cached views is freed at the end, because mapping needs no views.
    """
    with (
        threadpool_limits(thread_count(context.config.runtime), user_api="blas"),
        use_executor(context),
    ):
        yield
    context.images.release_views()
    release_free_memory()


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
    with extraction_environment(context):
        context.run_masks()
        graph = match_images(
            context,
            feature_table(context),
            unconstrained=unconstrained,
            verified=first.problem.pairs,
        )
        doubts = (*first.doubts, *find_wrong_providers(context, graph))
    problem = merge_matches(first.problem, graph.assembled)
    second = describe(context, problem, graph)
    return Extraction(problem, merge_reports(first.report, second), doubts)


def predict_priors_again(
    images: ImageSet,
    config: Config,
    registry: Registry,
    problem: MappingProblem,
    events: ExtractionEvents | None = None,
) -> MappingProblem:
    """Replace the depth and normals of a mapping problem by predictions on other views.

    Raises the same errors as :func:`extract`.

    Args:
        images: Images with the cameras of the mapping problem, in the same order.
        config: Configuration with a provider of monocular depth.
        registry: The installed providers.
        problem: Mapping problem on the views of ``images``.
        events: Receives progress.
    """
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    with extraction_environment(context):
        context.run_masks()
        priors = predict_priors(context, None)
    views = (
        replace(
            view,
            depth=priors.depth[view.name],
            normals=priors.normals[view.name],
            depth_focal_px=priors.depth_focal_px(image.pinhole),
        )
        for image, view in zip(images, problem.images, strict=True)
    )
    return replace(problem, images=tuple(views))


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
    if imported is None:
        graph = match_images(context, feature_table(context))
    else:
        graph = verify_imported(context, imported)
    priors = predict_priors(context, graph)
    problem = assemble_problem(context.images, graph, priors)
    doubts = () if imported is not None else find_wrong_providers(context, graph)
    return Extraction(problem, describe(context, problem, graph), doubts)


def feature_table(context: ExtractionContext) -> FeatureTable | None:
    """Return the features of the configured provider, or None if no feature provider is set."""
    features = context.config.features
    return None if features is None else FeatureTable(context, features)


def match_images(
    context: ExtractionContext,
    source: FeatureSource | None,
    *,
    pairs: list[Pair] | None = None,
    unconstrained: Collection[int] | None = None,
    verified: Sequence[VerifiedPair] = (),
) -> MatchGraph:
    """Select, match and verify pairs with the configured matchers, and adjust the keypoints.

    Args:
        context: Context of the extraction with images, configuration and providers.
        source: Features of the images, or None for a detector-free matcher.
        pairs: Index pairs of images to match, or None to select pairs as configured.
        unconstrained: Indices of images of which each pair contains at least one; if None, all
            pairs are allowed.
        verified: Pairs that an earlier pass verified, which connect components.
    """
    originals, images = find_duplicates(context), range(len(context.images))
    source = source and SharedFeatures(source, originals)
    located = [NO_FEATURES] * len(images) if source is None else source.extract(images)
    distinct = [image for image in images if image not in originals]
    selection = PairSelection(context, source, unconstrained, distinct)
    matcher = PairMatcher(context, source)
    verifier = PairVerifier(context, located, matcher)
    candidates = matcher.match(selection.choose() if pairs is None else pairs, located)
    geometries = verifier.verify(candidates)
    pairs_with_geometry = zip(candidates, geometries, strict=True)
    connected = [(pair.image_a, pair.image_b) for pair in verified]
    connected += [c.pair for c, geometry in pairs_with_geometry if not geometry.dropped]
    if pairs is None and (further_pairs := selection.choose_again(connected)):
        candidates += matcher.match(further_pairs, located)
        geometries += verifier.verify(candidates[len(geometries) :])
    assembled = adjust_assembled(context, assemble_matches(candidates, geometries, located))
    assembled = add_duplicates(assembled, originals)
    names = context.images.names
    features = {} if source is None else FeatureSet(names, source, context.config.features)
    proposed = selection.proposed if pairs is None else len(pairs)
    return MatchGraph(
        tuple(names),
        features,
        assembled,
        tuple(candidates),
        tuple(geometries),
        context.config.verification.min_inliers,
        proposed,
        matcher,
        {names[image]: names[original] for image, original in originals.items()},
    )


def match_queries(
    context: ExtractionContext, num_references: int, between: Sequence[Pair] = ()
) -> AssembledMatches:
    """Match images with similar images of a model, and verify the matches.

    Keypoints are not adjusted, so that the keypoints of the model do not depend on the queries.

    Args:
        context: Context of the extraction, whose first images are the images of the model.
        num_references: Number of images of the model; all further images are queries.
        between: Pairs of queries that are matched, too.
    """
    source = feature_table(context)
    images = range(len(context.images))
    located = [NO_FEATURES] * len(images) if source is None else source.extract(images)
    pairs = PairSelection(context, source).choose_references(num_references)
    matcher = PairMatcher(context, source)
    candidates = matcher.match(sorted([*pairs, *between]), located)
    geometries = PairVerifier(context, located, matcher).verify(candidates)
    return assemble_matches(candidates, geometries, located)


def verify_imported(context: ExtractionContext, imported: ImportedMatches) -> MatchGraph:
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
    names = context.images.names
    return MatchGraph(
        tuple(names),
        dict(zip(names, located, strict=True)),
        assemble_matches(candidates, geometries, located),
        tuple(candidates),
        tuple(geometries),
        context.config.verification.min_inliers,
        len(candidates),
    )


def predict_priors(context: ExtractionContext, graph: MatchGraph | None) -> Priors:
    """Predict calibrated depth and normals of all images.

    Args:
        context: Context of the extraction with images, configuration and providers.
        graph: Match graph, whose pairs define the groups of images for a multi-view network.
            Without a match graph, a group has consecutive images, and no matcher predicts depth.
    """
    names = context.images.names
    groups = _predict_groups(context, () if graph is None else graph.assembled.pairs)
    candidates = [] if graph is None else list(graph.candidates)
    matcher = None if graph is None else graph.matcher
    originals = find_duplicates(context)
    predictor = PriorPredictor(context, matcher, candidates, groups)
    predicted = predictor.run(originals)
    depth = {name: prior for name, (prior, _) in zip(names, predicted, strict=True)}
    normals = {name: prior for name, (_, prior) in zip(names, predicted, strict=True)}
    if groups is None or context.config.depth.use != FROM_MULTIVIEW:
        return Priors(depth, normals, follows_focal=predictor.follows_focal)
    places = {name: groups.place(originals.get(index, index)) for index, name in enumerate(names)}
    poses = {name: pose for name, (_, pose) in places.items() if pose is not None}
    numbers = {name: number for name, (number, _) in places.items()}
    return Priors(depth, normals, numbers, poses)


def assemble_problem(images: ImageSet, graph: MatchGraph, priors: Priors) -> MappingProblem:
    """Combine images, match graph and priors into the input of the mapper."""
    assembled = graph.assembled
    return MappingProblem(
        tuple(
            MappingImage(
                image.name,
                image.pinhole,
                assembled.keypoints[index],
                priors.depth[image.name],
                priors.normals[image.name],
                keypoint_std_px=assembled.std_px[index],
                keypoint_std_factor=assembled.std_factor[index],
                focal_known=image.focal_known,
                camera_id=image.camera.camera_id,
                focal_log_std=image.focal_log_std,
                camera_model=image.camera_model,
                depth_focal_px=priors.depth_focal_px(image.pinhole),
                depth_group=priors.groups.get(image.name),
                proposed_pose=priors.proposed_poses.get(image.name),
                duplicate_of=graph.duplicates.get(image.name),
            )
            for index, image in enumerate(images)
        ),
        assembled.pairs,
    )


def _predict_groups(
    context: ExtractionContext, pairs: tuple[VerifiedPair, ...]
) -> GroupPriors | None:
    """Run the multi-view network, if configured, on groups of images that share matches."""
    if context.config.multiview is None:
        return None
    groups = GroupPriors(context)
    groups.run({(pair.image_a, pair.image_b): len(pair) for pair in pairs})
    return groups
