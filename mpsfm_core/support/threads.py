"""Number of threads of a run: its own worker threads and those of BLAS, OpenMP and OpenCV.

A run sets the limit once with :func:`limited`, and thread pools read it with :func:`allowed`.
Providers get their number of threads from their context, because networks have thread pools of
their own.
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


def cores(groups: ControlGroups | None = None) -> int:
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


def allowed() -> int:
    """Return the number of threads that the caller may keep busy; without a limit, one per core."""
    return _LIMIT.get() or cores()


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function on every item in :func:`allowed` threads; return the results in order."""
    with ThreadPoolExecutor(allowed()) as pool:
        return list(pool.map(function, items))


@contextmanager
def limited(count: int | None) -> Iterator[None]:
    """Limit the number of busy threads inside a ``with`` block.

    The limit of :func:`allowed` applies to the calling thread, the limit of libraries to the whole
    process. OpenCV gets one thread, because several worker threads call it at the same time.

    Args:
        count: Largest number of threads; None means one per core.
    """
    token, opencv = _LIMIT.set(count), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(allowed()):
            yield
    finally:
        cv2.setNumThreads(opencv)
        _LIMIT.reset(token)
