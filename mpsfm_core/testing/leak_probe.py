"""Memory and objects of this process after repeated calls, to detect leaks."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import psutil


class ProcessUsage(NamedTuple):
    """Resources that this process uses after garbage collection."""

    memory_mb: float
    """Resident memory of the process in MB (1e6 bytes); on Linux, memory already freed is
    excluded."""
    objects: int
    """Number of objects that Python's garbage collector tracks."""
    files: int
    """Open file descriptors."""
    threads: int
    """Running threads."""


def measure_usage(run: Callable[[], object], count: int) -> Iterator[ProcessUsage]:
    """Call a function repeatedly and measure this process after each call (POSIX only).

    Args:
        run: Function without arguments.
        count: Number of calls.

    Yields:
        Resources of this process after each call.
    """
    for _ in range(count):
        run()
        yield read_usage()


def read_usage() -> ProcessUsage:
    """Measure the resources of this process after a garbage collection (POSIX only)."""
    gc.collect()
    # The C library glibc retains freed memory, which would count as resident.
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
    process = psutil.Process()
    memory = process.memory_info().rss / 1e6
    return ProcessUsage(memory, len(gc.get_objects()), process.num_fds(), process.num_threads())
