"""How many threads a run uses: ours, and those of the libraries below.

Whoever starts a run says the number once (:func:`limited`), pools ask for it (:func:`allowed`).
Providers are handed theirs in their context, since networks have pools of their own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import cv2
from threadpoolctl import threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # what a container or job scheduler allows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def allowed() -> int:
    """Threads that the caller may keep busy: the limit, or one a core where there is none."""
    return _LIMIT.get() or cores()


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What a function gives for each item, in order, on as many threads as are allowed."""
    with ThreadPoolExecutor(allowed()) as pool:
        return list(pool.map(function, items))


@contextmanager
def limited(count: int | None) -> Iterator[None]:
    """While this lasts, no more than ``count`` threads are busy; None is one a core.

    BLAS and OpenMP libraries that are loaded get as many. OpenCV gets one, since whoever has
    several photos in hand calls it from as many threads. The limit of ours is of the calling
    thread, that of libraries of the whole process.
    """
    token, opencv = _LIMIT.set(count), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(allowed()):
            yield
    finally:
        cv2.setNumThreads(opencv)
        _LIMIT.reset(token)
