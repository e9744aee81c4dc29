"""Tests of the time limit for calls of functions that other people wrote."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable

import pytest

from mpsfm_core.support.time_limit import time_limit

pytestmark = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs SIGALRM")


def sleep_stubbornly() -> None:
    for _ in range(2):
        try:
            time.sleep(5)
        except Exception:
            continue


@pytest.mark.parametrize(
    "function", [lambda: time.sleep(5), threading.Event().wait, sleep_stubbornly]
)
def test_blocking_function_is_interrupted(function: Callable[[], object]) -> None:
    started = time.monotonic()
    message = r"show\(\) does not return within 0.05 s"
    with pytest.raises(TimeoutError, match=message), time_limit(0.05, "show()"):
        function()
    assert time.monotonic() - started < 4
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_fast_function_and_its_errors_are_unchanged() -> None:
    handler = signal.getsignal(signal.SIGALRM)
    with time_limit(5, "a call"):
        pass
    with pytest.raises(KeyError), time_limit(5, "a call"):
        raise KeyError("image")
    assert signal.getsignal(signal.SIGALRM) == handler
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_outer_limit_remains_after_inner_one() -> None:
    with pytest.raises(TimeoutError, match="outer"), time_limit(0.1, "outer"):
        with time_limit(5, "inner"):
            pass
        time.sleep(5)


def test_other_threads_have_no_limit() -> None:
    ended = []

    def work() -> None:
        with time_limit(0.01, "a call"):
            time.sleep(0.05)
        ended.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert ended
