"""Number of threads of a run: its own worker threads and those of BLAS, OpenMP and OpenCV.

A run sets the limit once with :func:`limit_threads`, and thread pools read it with
:func:`thread_limit`. Providers get their number of threads from their context, because networks
have thread pools of their own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import cv2
from threadpoolctl import threadpool_limits

from mpsfm_core.support.control_groups import ControlGroups

Item = TypeVar("Item")
Result = TypeVar("Result")

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


def count_cores(groups: ControlGroups | None = None) -> int:
    """Return the number of processors that this process may use.

    Respects the CPU affinity and the CPU quota of containers. A fraction of a core counts as one.

    Args:
        groups: Source of the CPU quota; default: the control groups of this process.
    """
    if hasattr(os, "sched_getaffinity"):
        available = len(os.sched_getaffinity(0))
    else:
        available = os.cpu_count() or 1
    quota = (groups or ControlGroups()).cpu_quota()
    return available if quota is None else max(1, min(available, math.ceil(quota)))


def thread_limit() -> int:
    """Return the number of threads that the caller may keep busy; without a limit, one per core."""
    return _LIMIT.get() or count_cores()


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function on every item in parallel threads; returns the results in order."""
    with ThreadPoolExecutor(thread_limit()) as pool:
        return list(pool.map(function, items))


@contextmanager
def limit_threads(count: int | None) -> Iterator[None]:
    """Limit the number of busy threads inside a ``with`` block.

    The limit of :func:`thread_limit` applies to the calling thread, the limit of libraries to the
    whole process. OpenCV gets one thread, because several worker threads call it at the same time.

    Args:
        count: Largest number of threads; None means one per core.
    """
    token, opencv = _LIMIT.set(count), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(thread_limit()):
            yield
    finally:
        cv2.setNumThreads(opencv)
        _LIMIT.reset(token)
