"""Extraction stages on the workers of an executor, such as Ray or Dask, and a shared cache.

A remote worker creates its own providers from the configuration and from the plugins on its
machine. The worker writes results to the shared cache, from which the main process loads them.
"""

from __future__ import annotations

import socket
import threading
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data.errors import ConfigError, InputError, did_you_mean
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.cache import content_key
from mpsfm_core.extraction.context import RUNS, ExtractionContext
from mpsfm_core.extraction.events import NullExtractionEvents
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
from mpsfm_core.providers.first_party import EXECUTORS
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.threads import limit_threads

THREADS = "threads"


@contextmanager
def use_executor(context: ExtractionContext) -> Iterator[None]:
    """Run the stages of extraction on the configured executor inside a ``with`` block.

    Raises:
        ConfigError: no plugin provides the executor, or its workers are unavailable.
    """
    executor = create_executor(context.config.runtime, context.registry)
    if executor is None:
        yield
        return
    context.run_remotely = _RemoteStages(context, executor)
    try:
        yield
    finally:
        executor.close()


def create_executor(runtime: RuntimeOptions, registry: Registry) -> Executor | None:
    """Create the configured executor, or return None if all work runs on threads.

    Raises:
        ConfigError: no plugin provides the executor, or its workers are unavailable.
    """
    name, options = runtime.executor, runtime.executor_options
    if name == THREADS:
        return None
    created: Executor | None = registry.hook.mpsfm_executor(name=name, options=options)
    if created is None:
        known = (THREADS, *EXECUTORS)
        hint = (
            f": pip install {EXECUTORS[name]}" if name in EXECUTORS else did_you_mean(name, known)
        )
        raise ConfigError(f"runtime.executor: no plugin provides {name!r}{hint}")
    return created


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
            _worker_state(self).work[self.stage](item)


class _WorkerState:
    """Providers of a remote worker, and the function that runs each stage."""

    def __init__(self, step: RemoteStep) -> None:
        config = step.config
        context = ExtractionContext(
            step.images, config, Registry.discover(), NullExtractionEvents()
        )
        context.shared_run = step.run
        if context.cache.load(RUNS, content_key(step.run), np.ndarray) is None:
            raise InputError(
                f"the worker on {socket.gethostname()} does not see the cache "
                f"{context.cache.folder} of this run: set runtime.cache_dir to a folder that all "
                "machines share"
            )
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


_LOCK = threading.Lock()
_WORKER_STATES: dict[str, _WorkerState] = {}


def _worker_state(step: RemoteStep) -> _WorkerState:
    """Return the worker state of a run; states of earlier runs are dropped."""
    with _LOCK:
        if step.run not in _WORKER_STATES:
            _WORKER_STATES.clear()
            _WORKER_STATES[step.run] = _WorkerState(step)
        return _WORKER_STATES[step.run]
