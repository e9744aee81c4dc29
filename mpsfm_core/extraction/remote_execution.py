"""Steps of the extraction on workers elsewhere: they leave what they find in the shared cache.

A worker makes its own providers from the configuration and the plugins that are installed there,
and does to an item what a thread of this process would do; this process then finds the result in
the cache.
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

from mpsfm_core.config import Config
from mpsfm_core.data.errors import ConfigError, InputError, did_you_mean
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.cache import content_key
from mpsfm_core.extraction.context import RUNS, ExtractionContext
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.matching.pair_matching import PairMatcher
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
    """While this lasts, the stages that the executor's workers can do are done there first.

    Raises :class:`ConfigError` when no plugin brings the executor, or its workers cannot be had.
    """
    executor = _executor(context)
    if executor is None:
        yield
        return
    context.elsewhere = _RemoteStages(context, executor)
    try:
        yield
    finally:
        executor.close()


def _executor(context: ExtractionContext) -> Executor | None:
    runtime = context.config.runtime
    name, options = runtime.executor, runtime.executor_options
    if name == THREADS:
        return None
    found: Executor | None = context.registry.hook.mpsfm_executor(name=name, options=options)
    if found is None:
        known = (THREADS, *EXECUTORS)
        hint = (
            f": pip install {EXECUTORS[name]}" if name in EXECUTORS else did_you_mean(name, known)
        )
        raise ConfigError(f"runtime.executor: no plugin brings {name!r}{hint}")
    return found


class _RemoteStages:
    """The stages of a run that its executor's workers do."""

    def __init__(self, context: ExtractionContext, executor: Executor) -> None:
        runtime = context.config.runtime.model_copy(update={"executor": THREADS})
        config = context.config.model_copy(update={"runtime": runtime})
        self._step = RemoteStep(uuid.uuid4().hex, "", context.images, config)
        self._executor = executor
        context.shared_run = self._step.run
        context.cache.store(RUNS, content_key(self._step.run), np.array(True))

    def __call__(self, stage: str, items: Sequence[Any]) -> Generator[None, None, None]:
        """Run a stage; yields after each item."""
        return self._executor.run(replace(self._step, stage=stage), items)


@dataclass(frozen=True)
class RemoteStep:
    """A stage, to be called with an item on any machine.

    ``run``: names the run; a worker keeps its providers from step to step.
    """

    run: str
    stage: str
    images: ImageSet
    config: Config

    def __call__(self, item: Any) -> None:
        with limit_threads(thread_count(self.config.runtime)):
            _worker_state(self).work[self.stage](item)


class _WorkerState:
    """What a worker has of a run: how each stage works on an item."""

    def __init__(self, step: RemoteStep) -> None:
        config = step.config
        context = ExtractionContext(step.images, config, Registry.discover(), NullExtractionEvents())
        context.shared_run = step.run
        if context.cache.load(RUNS, content_key(step.run), np.ndarray) is None:
            raise InputError(
                f"the worker on {socket.gethostname()} does not see the cache {context.cache.folder} "
                f"of this run: set runtime.cache_dir to a folder that all machines share"
            )
        context.take_masks()
        table = None if config.features is None else FeatureTable(context, config.features)
        matcher = PairMatcher(context, table)
        priors = PriorPredictor(context, matcher, [])
        self.work: dict[str, Callable[[Any], object]] = {
            "masks": context.mask,
            "retrieval": PairSelection(context, table).describe,
            "matching": matcher.results,
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
    """This process's own, of the latest run alone."""
    with _LOCK:
        if step.run not in _WORKER_STATES:
            _WORKER_STATES.clear()
            _WORKER_STATES[step.run] = _WorkerState(step)
        return _WORKER_STATES[step.run]
