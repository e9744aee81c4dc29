"""How long the whole run still takes, by how long its steps took per unit so far and last time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version

TIMINGS = "timings.json"
FORMAT = 1
"""Of ``timings.json``."""
_FIRST_GUESS = {
    "features": 0.3,
    "matching": 0.5,
    "verification": 0.01,
    "adjustment": 0.01,
    "depth": 0.3,
    "normals": 0.1,
    "mapping": 1.0,
    "dense": 0.7,
    "results": 0.3,
    "report": 0.1,
}
"""Steps in their order, with seconds a unit (an image, of pairwise steps a pair) on two
cores, with the default configuration (measured with 28 photos of a room; dense with 16 of a
rendered kitchen). Where a run went before, its own are taken."""
_PAIRWISE = {"matching", "verification", "adjustment"}
_TRUST_AFTER = 0.2
"""Share of a step after which its own speed is believed alone (ours)."""


class TimeLeft:
    """``told`` by the events of a run; ``seconds`` is the answer.

    ``cache_dir``: of the run; the speeds are kept there for the next one.
    """

    def __init__(
        self, cache_dir: Path | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._file = cache_folder(cache_dir) / TIMINGS
        self._clock = clock
        self._usual = {**_FIRST_GUESS, **_read(self._file)}
        self._images = 0
        self._running: dict[str, tuple[float, int, int]] = {}
        self._ended: dict[str, float] = {}

    def started(self, step: str, total: int | None) -> None:
        """A step begins, of so many units."""
        if step in _FIRST_GUESS:
            if step == "features" and total:
                self._images = total
            self._running[step] = (self._clock(), 0, total or self._units(step))

    def progress(self, step: str, done: int, total: int) -> None:
        """Units of a step that are done."""
        if step in self._running:
            self._running[step] = (self._running[step][0], done, total)

    def finished(self, step: str) -> None:
        """A step ended; its speed is kept unless it had nothing to do."""
        if step in self._running:
            start, _, total = self._running.pop(step)
            if total:
                self._ended[step] = (self._clock() - start) / total

    def seconds(self) -> float | None:
        """Until the run ends, None while nobody knows how many images there are."""
        if not self._images:
            return None
        steps = list(_FIRST_GUESS)
        reached = max(steps.index(step) for step in (*self._running, *self._ended))
        left = sum(self._left_of(step) for step in self._running)
        return left + sum(self._usual[step] * self._units(step) for step in steps[reached + 1 :])

    def keep(self) -> None:
        """For the next run; a cache that cannot be written is none of the user's worries here."""
        known = {**_read(self._file), **{k: round(v, 6) for k, v in self._ended.items()}}
        with suppress(OSError):
            write_file(self._file, json.dumps({VERSION: FORMAT, **known}))

    def _left_of(self, step: str) -> float:
        start, done, total = self._running[step]
        spent = self._clock() - start
        usual = self._usual[step] * (total - done)
        if not done or not total:
            return max(usual - spent, 0.0)
        trust = min(1.0, done / total / _TRUST_AFTER)
        return trust * spent / done * (total - done) + (1 - trust) * usual

    def _units(self, step: str) -> int:
        count = self._images
        return count * (count - 1) // 2 if step in _PAIRWISE else count


def in_words(seconds: float | None) -> str:
    """As ``about 3 min left``; nothing for None."""
    if seconds is None:
        return ""
    if seconds < 60:
        return "less than a minute left"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} min left"
    return f"about {seconds / 3600:.1f} h left"


def _read(file: Path) -> dict[str, float]:
    try:
        known = json.loads(file.read_text(encoding="utf-8"))
        check_version(known, FORMAT, file)
        return {step: float(known[step]) for step in _FIRST_GUESS if step in known}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, InputError):
        return {}
