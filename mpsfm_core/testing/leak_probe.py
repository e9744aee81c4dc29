"""What a process holds on to after it has done the same again and again."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import psutil


class ProcessUsage(NamedTuple):
    """Resident memory without what is free in it (MB, 1e6 bytes), objects that Python's collector
    knows, open files, threads."""

    memory_mb: float
    objects: int
    files: int
    threads: int


def measure_usage(run: Callable[[], object], count: int) -> Iterator[ProcessUsage]:
    """What this process holds after each of ``count`` calls. POSIX only."""
    process = psutil.Process()
    for _ in range(count):
        run()
        gc.collect()
        if sys.platform == "linux":  # else what is freed counts where the library keeps it
            ctypes.CDLL(None).malloc_trim(0)
        memory = process.memory_info().rss / 1e6
        yield ProcessUsage(memory, len(gc.get_objects()), process.num_fds(), process.num_threads())
