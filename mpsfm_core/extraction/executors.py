"""Executors, such as Ray and Dask, which run the items of a stage on remote workers.

The main process sends a pickled function and its items to the workers, which read inputs from the
shared cache folder and write results to it. :mod:`~mpsfm_core.extraction.remote_execution`,
:mod:`mpsfm_core.pipeline.parts` and :mod:`mpsfm_core.pipeline.remote_stereo` define the functions.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data.errors import ConfigError, InputError, did_you_mean
from mpsfm_core.providers import Executor
from mpsfm_core.providers.first_party import EXECUTORS
from mpsfm_core.providers.registry import Registry

State = TypeVar("State")

THREADS = "threads"
"""Value of ``runtime.executor`` without remote workers."""


@contextmanager
def open_executor(runtime: RuntimeOptions, registry: Registry) -> Iterator[Executor | None]:
    """Open the configured executor in a ``with`` block; yield None if all work runs on threads.

    Raises:
        ConfigError: no plugin provides the executor, or its workers are unavailable.
    """
    name, options = runtime.executor, runtime.executor_options
    if name == THREADS:
        yield None
        return
    executor: Executor | None = registry.hook.mpsfm_executor(name=name, options=options)
    if executor is None:
        known = (THREADS, *EXECUTORS)
        hint = (
            f": pip install {EXECUTORS[name]}" if name in EXECUTORS else did_you_mean(name, known)
        )
        raise ConfigError(f"runtime.executor: no plugin provides {name!r}{hint}")
    with closing(executor):
        yield executor


def finish_items(run: Generator[None, None, None], progress: Callable[[int], None]) -> None:
    """Wait until an executor has processed all items, and report the number of finished items.

    Args:
        run: Result of :meth:`mpsfm_core.providers.Executor.run`. An error or Ctrl-C closes the
            generator, which cancels the remaining items.
        progress: Callback that receives the number of finished items.
    """
    with closing(run):
        for done, _ in enumerate(run, start=1):
            progress(done)


def missing_cache_error(folder: Path) -> InputError:
    """Return the error of a worker that does not find a file of the run in its cache folder."""
    return InputError(
        f"the worker on {socket.gethostname()} does not see the cache {folder} of this run: set "
        "runtime.cache_dir to a folder that all machines share"
    )


_LOCK = threading.Lock()
_WORKER_STATES: dict[str, Any] = {}


def worker_state(run: str, create: Callable[[], State]) -> State:
    """Return the state of this worker for a run; states of earlier runs are dropped.

    Args:
        run: Unique identifier of the run.
        create: Function that creates the state before the first item of the run.
    """
    with _LOCK:
        if run not in _WORKER_STATES:
            _WORKER_STATES.clear()
            _WORKER_STATES[run] = create()
        state: State = _WORKER_STATES[run]
        return state
