"""Executor in this process, which processes items in another order than threads."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from mpsfm_core import hookimpl


class Backwards:
    """Executor that runs a pickled step on the last item first, like other processes."""

    def __init__(self) -> None:
        self.items: dict[type, list[Any]] = {}
        self.closed = 0

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        self.items[type(step)] = list(items)
        for item in reversed(items):
            pickle.loads(pickle.dumps(step))(pickle.loads(pickle.dumps(item)))
            yield

    def close(self) -> None:
        self.closed += 1

    @hookimpl
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Backwards | None:
        return self if name == "backwards" else None
