"""Extraction stages on the workers of an executor, such as Ray or Dask, and a shared cache.

A remote worker creates its own providers from the configuration and from the plugins on its
machine. The worker writes results to the shared cache, from which the main process loads them.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpsfm_core.config import Config
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.cache import content_key
from mpsfm_core.extraction.context import RUNS, ExtractionContext
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.executors import (
    THREADS,
    missing_cache_error,
    open_executor,
    worker_state,
)
from mpsfm_core.extraction.features import NO_FEATURES, FeatureTable
from mpsfm_core.extraction.matching.keypoint_adjustment import KeypointAdjuster
from mpsfm_core.extraction.matching.pair_matching import (
    LocatedFeatures,
    PairMatcher,
    PairVerifier,
)
from mpsfm_core.extraction.pairs.selection import PairSelection
from mpsfm_core.extraction.priors.multiview import GroupPriors
from mpsfm_core.extraction.priors.prior_predictor import PriorPredictor
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.providers import Executor
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.threads import limit_threads


@contextmanager
def use_executor(context: ExtractionContext) -> Iterator[None]:
    """Run the stages of extraction on the configured executor inside a ``with`` block.

    Raises:
        ConfigError: no plugin provides the executor, or its workers are unavailable.
    """
    with open_executor(context.config.runtime, context.registry) as executor:
        if executor is not None:
            context.run_remotely = _RemoteStages(context, executor)
        yield


class _RemoteStages:
    """Runs the extraction stages of one reconstruction on a remote executor."""

    def __init__(self, context: ExtractionContext, executor: Executor) -> None:
        runtime = context.config.runtime.model_copy(update={"executor": THREADS})
        config = context.config.model_copy(update={"runtime": runtime})
        self._step = RemoteStep(uuid.uuid4().hex, "", context.images, config)
        self._executor = executor
        context.shared_run = self._step.run
        context.cache.store(RUNS, content_key(self._step.run), np.array(True))

    def __call__(self, stage: str, items: Sequence[Any]) -> Generator[None, None, None]:
        """Run a stage on the executor; yield after each finished item."""
        return self._executor.run(replace(self._step, stage=stage), items)


@dataclass(frozen=True)
class RemoteStep:
    """Pickled function that processes an item of a stage on any machine."""

    run: str
    """Identifier of the run; a remote worker keeps only the providers of its latest run."""
    stage: str
    images: ImageSet
    config: Config

    def __call__(self, item: Any) -> None:
        """Process an item and write the result to the shared cache."""
        with limit_threads(thread_count(self.config.runtime)):
            state = worker_state(self.run, lambda: _WorkerState(self))
            state.work[self.stage](item)


class _WorkerState:
    """Providers of a remote worker, and the function that runs each stage."""

    def __init__(self, step: RemoteStep) -> None:
        config = step.config
        context = ExtractionContext(
            step.images, config, Registry.discover(), NullExtractionEvents()
        )
        context.shared_run = step.run
        if context.cache.load(RUNS, content_key(step.run), np.ndarray) is None:
            raise missing_cache_error(context.cache.folder)
        context.load_masks()
        table = None if config.features is None else FeatureTable(context, config.features)
        matcher = PairMatcher(context, table)
        located: LocatedFeatures = [NO_FEATURES] * len(step.images) if table is None else table
        priors = PriorPredictor(context, matcher, [])
        self.work: dict[str, Callable[[Any], object]] = {
            "masks": context.mask,
            "retrieval": PairSelection(context, table).describe,
            "matching": matcher.results,
            "verification": PairVerifier(context, located, matcher).verify_pair,
            "adjustment": KeypointAdjuster(context).align_stored,
            "depth": priors.predicted,
            "normals": priors.full_size,
        }
        if config.multiview is not None:
            self.work["multiview"] = GroupPriors(context).predict
        if table is not None:
            self.work["features"] = table.__getitem__
