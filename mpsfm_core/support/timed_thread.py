"""Thread whose caller stops waiting after a time limit."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, TypeVar, cast

T = TypeVar("T")


class TimeLimitError(TimeoutError):
    """Error if a function takes longer than its time limit.

    Functions may raise other TimeoutErrors themselves, for example if a server does not answer.
    """


class TimedThread:
    """Daemon thread that runs functions of another thread, so that the caller can stop waiting.

    One thread for all calls is faster than a new thread for each call. The thread ends when the
    object is deleted and the last function has returned.
    """

    def __init__(self, name: str) -> None:
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        threading.Thread(target=_run_calls, args=(self._calls,), name=name, daemon=True).start()
        weakref.finalize(self, self._calls.put, None)

    def run(self, compute: Callable[[], T], timeout_s: float) -> T:
        """Run a function and return its result or raise its exception.

        Raises:
            TimeLimitError: The function takes longer than ``timeout_s`` seconds. The thread runs no
                other function before this one returns.
        """
        call = _Call(compute, SimpleQueue())
        self._calls.put(call)
        try:
            result, error = call.outcome.get(timeout=timeout_s)
        except Empty:
            raise TimeLimitError from None
        if error is not None:
            try:
                raise error
            finally:
                del error  # the error refers to this frame, and so to the thread
        return cast(T, result)


class _Call(NamedTuple):
    """Function for another thread.

    Each call has its own queue, because the caller may be interrupted before the function returns.
    """

    compute: Callable[[], Any]
    outcome: SimpleQueue[tuple[Any, BaseException | None]]
    """Queue that receives the result, or None and the exception."""


def _run_calls(calls: SimpleQueue[_Call | None]) -> None:
    """Run functions from a queue until it contains None."""
    while (call := calls.get()) is not None:
        try:
            call.outcome.put((call.compute(), None))
        except BaseException as error:
            call.outcome.put((None, error))
        del call  # its function may hold large arrays
