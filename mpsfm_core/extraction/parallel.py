"""Steps of a stage on several threads, with progress; results do not depend on their number."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
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
) -> list[Result]:
    """``[work(item) for item in items]``, in parallel.

    The first exception, and Ctrl-C, stops the stage: steps that run are finished, the rest is
    dropped. Events are sent from the calling thread.

    Threads, not processes: providers compute in native code that releases the interpreter, and a
    process would load its own copy of every library and network.
    """
    started = time.perf_counter()
    events.stage_started(stage, len(items))
    futures: list[Future[Result]] = []
    pool = ThreadPoolExecutor(max(1, workers), thread_name_prefix=f"mpsfm-{stage}")
    try:
        futures = [pool.submit(work, item) for item in items]
        for done, future in enumerate(as_completed(futures), start=1):
            future.result()
            events.stage_progress(stage, done, len(items))
        return [future.result() for future in futures]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        events.stage_finished(stage, time.perf_counter() - started)
