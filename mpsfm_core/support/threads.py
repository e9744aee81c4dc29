"""Number of threads of a run: worker threads and threads of BLAS, OpenMP and OpenCV.

A run sets the thread limit once with :func:`limit_threads`, and thread pools read the limit with
:func:`thread_limit`. Providers get their number of threads from ``ProviderContext``, because
networks have separate thread pools.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import cache
from typing import TypeVar

import cv2
from threadpoolctl import threadpool_limits

from mpsfm_core.support.control_groups import ControlGroups

Item = TypeVar("Item")
Result = TypeVar("Result")

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


def count_cores(groups: ControlGroups | None = None) -> int:
    """Return the number of CPU cores that this process may use.

    CPU affinity and the CPU quota of containers are respected. A quota is rounded up to whole
    cores.

    Args:
        groups: Linux control groups with a CPU quota, by default those of this process at the first
            call.
    """
    if hasattr(os, "sched_getaffinity"):
        available = len(os.sched_getaffinity(0))
    else:
        available = os.cpu_count() or 1
    quota = _own_cpu_quota() if groups is None else groups.cpu_quota()
    return available if quota is None else max(1, min(available, math.ceil(quota)))


@cache
def _own_cpu_quota() -> float | None:
    """Return the CPU quota of this process, which is read once, because files are slow."""
    return ControlGroups().cpu_quota()


def thread_limit() -> int:
    """Return the thread limit of the calling thread; without a limit, the number of cores."""
    return _LIMIT.get() or count_cores()


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function on every list item in parallel threads; return the results in order.

    The threads have the context variables of the calling thread, such as the thread limit.
    """
    context = copy_context()

    def call(item: Item) -> Result:
        # Two threads cannot run in the same context, so each call runs in a copy.
        return context.copy().run(function, item)

    with ThreadPoolExecutor(thread_limit()) as pool:
        return list(pool.map(call, items))


@contextmanager
def limit_threads(count: int | None) -> Iterator[None]:
    """Limit the number of threads inside a ``with`` block.

    The limit that :func:`thread_limit` returns changes only for the calling thread. The number of
    threads of BLAS and OpenMP is limited in the whole process. OpenCV gets one thread, because
    several worker threads call OpenCV at the same time.

    Args:
        count: Maximum number of threads, or None for one thread per core.
    """
    token = _LIMIT.set(count)
    try:
        with opencv_threads(1), threadpool_limits(thread_limit()):
            yield
    finally:
        _LIMIT.reset(token)


@contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """Set the number of threads that OpenCV uses in each call inside a ``with`` block.

    Use 1 where several threads of the run call OpenCV at the same time.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
