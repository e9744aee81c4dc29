"""Test of the thread whose caller stops waiting after a time limit."""

from __future__ import annotations

import threading
import time

import pytest

from mpsfm_core.support.timed_thread import TimedThread, TimeLimitError


def test_timed_thread_runs_calls_and_ends() -> None:
    thread = TimedThread("a thread")
    seen = [thread.run(threading.current_thread, 5) for _ in range(3)]
    with pytest.raises(ZeroDivisionError):
        thread.run(lambda: 1 / 0, 5)
    assert len(set(seen)) == 1 and seen[0] is not threading.current_thread()
    with pytest.raises(TimeLimitError):
        thread.run(lambda: time.sleep(0.2), 0.01)
    assert thread.run(lambda: "the result of this call", 5) == "the result of this call"
    del thread
    seen[0].join(5)
    assert not seen[0].is_alive()
