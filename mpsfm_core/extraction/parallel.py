"""Parallel extraction stages with progress; results do not depend on the thread count."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from typing import TypeVar

from mpsfm_core.extraction.events import ExtractionEvents
from mpsfm_core.extraction.executors import finish_items

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_stage(
    events: ExtractionEvents,
    stage: str,
    items: Sequence[Item],
    work: Callable[[Item], Result],
    workers: int,
    remote: Generator[None, None, None] | None = None,
) -> list[Result]:
    """Compute ``[work(item) for item in items]`` in parallel threads.

    The first exception, or Ctrl-C, stops the stage when the running calls of ``work`` end. Threads
    suffice, because providers compute in native code that releases Python's global interpreter
    lock. Processes would each load a copy of every library and network.

    Args:
        events: Receiver of progress; called in the calling thread.
        stage: Name of the extraction stage, for progress messages.
        items: Items to process, each by one call of ``work``.
        work: Function that processes one item and returns the result.
        workers: Number of threads.
        remote: Generator that yields whenever a remote worker has written an item's result to the
            cache. The generator is exhausted before the local machine processes the items.

    Returns:
        The results in the order of the items.
    """
    started = time.perf_counter()
    events.stage_started(stage, len(items))

    def progress(done: int) -> None:
        events.stage_progress(stage, done, len(items))

    try:
        if remote is None:
            return _run_on_threads(stage, items, work, workers, progress)
        finish_items(remote, progress)
        return _run_on_threads(stage, items, work, workers)
    finally:
        events.stage_finished(stage, time.perf_counter() - started)


def _run_on_threads(
    stage: str,
    items: Sequence[Item],
    work: Callable[[Item], Result],
    workers: int,
    progress: Callable[[int], None] = lambda _: None,
) -> list[Result]:
    futures: list[Future[Result]] = []
    pool = ThreadPoolExecutor(max(1, workers), thread_name_prefix=f"mpsfm-{stage}")
    try:
        futures = [pool.submit(work, item) for item in items]
        for done, future in enumerate(as_completed(futures), start=1):
            future.result()
            progress(done)
        return [future.result() for future in futures]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
