"""Time limit for calls of functions that other people wrote, such as hooks of plugins."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_REPEAT_S = 1.0
"""Interval in seconds of further interruptions, because the function may catch the first one."""


class _Interruption(BaseException):
    """Interruption of the ``with`` block, which ``except Exception`` does not catch."""


@contextmanager
def time_limit(seconds: float, what: str) -> Iterator[None]:
    """Interrupt the ``with`` block by an exception if it takes too long.

    Native code is interrupted only when it returns to Python. Without SIGALRM (on Windows), and
    in other threads than the main thread, there is no limit.

    Args:
        seconds: Time limit; infinity sets no limit.
        what: Name of the called function for the message.

    Raises:
        TimeoutError: the block does not end within the time limit.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and hasattr(signal, "setitimer") and math.isfinite(seconds)):
        yield
        return
    is_active = True

    def interrupt(*_: Any) -> None:
        if is_active:
            raise _Interruption

    started = time.monotonic()
    handler = signal.signal(signal.SIGALRM, interrupt)
    outer_s, interval_s = signal.setitimer(signal.ITIMER_REAL, seconds, _REPEAT_S)
    try:
        try:
            yield
        finally:
            is_active = False
    except _Interruption:
        raise TimeoutError(f"{what} does not return within {seconds:g} s") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        if outer_s:
            left_s = outer_s - (time.monotonic() - started)
            signal.setitimer(signal.ITIMER_REAL, max(left_s, 1e-3), interval_s)
