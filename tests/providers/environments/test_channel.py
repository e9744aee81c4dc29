"""Tests of the message channel with both ends in one process."""

from __future__ import annotations

import os
from contextlib import ExitStack

import numpy as np
import pytest

from mpsfm_core.providers.environments.channel import Channel


@pytest.fixture
def ends(tmp_path):
    """Return a client end, whose received arrays are views of shared memory, and a server end."""
    there, back, modes = os.pipe(), os.pipe(), ("rb", "wb")
    with ExitStack() as stack:
        (answer_in, ask_out), (ask_in, answer_out) = (
            [stack.enter_context(os.fdopen(end, mode)) for end, mode in zip(p, modes, strict=True)]
            for p in (there, back)
        )
        asking = Channel(ask_in, ask_out, tmp_path, "a", "b", lent=2)
        yield asking, Channel(answer_in, answer_out, tmp_path, "b", "a")


def exchange(ends, value):
    asking, answering = ends
    asking.send(value)
    answering.send(answering.receive())
    return asking.receive()


def test_answers_stay_as_they_are_for_as_long_as_they_are_kept(ends):
    kept = [exchange(ends, [np.full(5000, k), np.arange(3)]) for k in range(6)]
    for k, (filled, counted) in enumerate(kept):
        assert (filled == k).all() and counted.tolist() == [0, 1, 2]
        assert not filled.flags.writeable


def test_memory_is_lent_and_used_again(ends, tmp_path):
    first = exchange(ends, np.arange(10.0))
    assert first.base is not None
    for size in (10, 20_000, 10):
        part = exchange(ends, np.arange(float(size)))[:2]
        # A slice of the array keeps the message alive, as the whole array does.
        assert part.tolist() == [0, 1]
    del part
    exchange(ends, np.arange(3))
    assert first.tolist() == np.arange(10.0).tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a0", "b0", "b1", "b2"]


def test_message_larger_than_earlier_messages_is_received(ends):
    for size in (1, 100_000, 10):
        assert exchange(ends, {"x": np.ones(size)})["x"].sum() == size
