"""Memory that this process may use or does not need, and the peak memory of child processes."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache

import psutil

from mpsfm_core.support.control_groups import ControlGroups

MB = float(1 << 20)
_SAMPLING_PERIOD_S = 1.0


def measure_memory(groups: ControlGroups | None = None) -> tuple[float, float]:
    """Return total and free memory in MB that this process may use.

    Args:
        groups: Control groups with memory limits; default: the control groups of this process.
    """
    machine = psutil.virtual_memory()
    limits = (groups or ControlGroups()).memory_limits()
    total = min([machine.total, *(limit.total for limit in limits)])
    free = min([machine.available, *(limit.free for limit in limits)])
    return total / MB, free / MB


def release_free_memory() -> None:
    """Return freed memory to the operating system, where the C library can (glibc).

    Otherwise, memory that freed arrays leave between used memory stays with the process.
    """
    with suppress(OSError, TypeError, AttributeError):
        _c_library().malloc_trim(0)


@cache
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None)


class ChildMemoryMonitor:
    """Measures the peak resident memory of all child processes together."""

    def __init__(self) -> None:
        self.peak_mb = 0.0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Sample the memory of child processes once per second inside a ``with`` block."""
        ended = threading.Event()
        thread = threading.Thread(target=self._sample_until, args=(ended,), name="mpsfm memory")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _sample_until(self, ended: threading.Event) -> None:
        process = psutil.Process()
        while not ended.wait(_SAMPLING_PERIOD_S):
            resident = 0
            with suppress(psutil.Error):
                for child in process.children(recursive=True):
                    with suppress(psutil.Error):
                        resident += child.memory_info().rss
            self.peak_mb = max(self.peak_mb, resident / MB)
