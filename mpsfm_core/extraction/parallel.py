"""Steps of a stage on several threads, with progress; results do not depend on their number."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import closing
from typing import TypeVar

from mpsfm_core.extraction.events import ExtractionEvents

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_stage(
    events: ExtractionEvents,
    stage: str,
    items: Sequence[Item],
    work: Callable[[Item], Result],
    workers: int,
    ahead: Generator[None, None, None] | None = None,
) -> list[Result]:
    """``[work(item) for item in items]``, in parallel.

    The first exception, and Ctrl-C, stops the stage: steps that run are finished, the rest is
    dropped. Events are sent from the calling thread. ``ahead`` yields after each item that workers
    elsewhere have done, before work on them begins here.

    Threads, not processes: providers compute in native code that releases the interpreter, and a
    process would load its own copy of every library and network.
    """
    started = time.perf_counter()
    events.stage_started(stage, len(items))

    def progress(done: int) -> None:
        events.stage_progress(stage, done, len(items))

    try:
        if ahead is None:
            return _on_threads(stage, items, work, workers, progress)
        with closing(ahead):
            for done, _ in enumerate(ahead, start=1):
                progress(done)
        return _on_threads(stage, items, work, workers)
    finally:
        events.stage_finished(stage, time.perf_counter() - started)


def _on_threads(
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
