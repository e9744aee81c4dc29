"""Estimation of the remaining time of a run from the speed of its stages."""

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
"""File in the cache folder with the stage speeds of earlier runs."""
FORMAT = 1
"""Version number of the format of ``timings.json``."""
_DEFAULT_SECONDS = {
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
"""Stages in order, with seconds per image or pair (two cores, default configuration).

Stage speeds of earlier runs on the same machine replace the default values."""
_PAIRWISE = {"matching", "verification", "adjustment"}
"""Stages whose work is counted in image pairs instead of images."""
_FULL_WEIGHT_RATIO = 0.2
"""Completed ratio of a stage above which the estimate uses only the measured speed [ours]."""


class RemainingTimeEstimator:
    """Estimator of the remaining time of a run, updated by progress events.

    Args:
        cache_dir: Cache folder, in which stage speeds are stored for the next run.
        clock: Function that returns the current time in seconds.
    """

    def __init__(
        self, cache_dir: Path | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._file = cache_folder(cache_dir) / TIMINGS
        self._clock = clock
        self._expected = {**_DEFAULT_SECONDS, **_read_timings(self._file)}
        self._images = 0
        self._running: dict[str, tuple[float, int, int]] = {}
        self._ended: dict[str, float] = {}

    def start_stage(self, stage: str, total: int | None) -> None:
        """Record the start of a stage and its number of images or pairs."""
        if stage in _DEFAULT_SECONDS:
            if stage == "features" and total:
                self._images = total
            self._running[stage] = (self._clock(), 0, total or self._num_units(stage))

    def update_stage(self, stage: str, done: int, total: int) -> None:
        """Record the number of finished images or pairs of a stage."""
        if stage in self._running:
            self._running[stage] = (self._running[stage][0], done, total)

    def finish_stage(self, stage: str) -> None:
        """Record the end and the speed of a stage."""
        if stage in self._running:
            start, _, total = self._running.pop(stage)
            if total:
                self._ended[stage] = (self._clock() - start) / total

    def seconds(self) -> float | None:
        """Estimate the seconds until the end of the run, or None before features are extracted."""
        if not self._images:
            return None
        stages = list(_DEFAULT_SECONDS)
        latest = max(stages.index(stage) for stage in (*self._running, *self._ended))
        running = sum(self._remaining_seconds(stage) for stage in self._running)
        return running + sum(
            self._expected[stage] * self._num_units(stage) for stage in stages[latest + 1 :]
        )

    def save(self) -> None:
        """Store the stage speeds for the next run, if the cache folder is writable."""
        speeds = {stage: round(seconds, 6) for stage, seconds in self._ended.items()}
        timings = {**_read_timings(self._file), **speeds}
        with suppress(OSError):
            write_file(self._file, json.dumps({VERSION: FORMAT, **timings}))

    def _remaining_seconds(self, stage: str) -> float:
        """Estimate the seconds until the end of a running stage."""
        start, done, total = self._running[stage]
        elapsed = self._clock() - start
        expected = self._expected[stage] * (total - done)
        if not done or not total:
            return max(expected - elapsed, 0.0)
        weight = min(1.0, done / total / _FULL_WEIGHT_RATIO)
        return weight * elapsed / done * (total - done) + (1 - weight) * expected

    def _num_units(self, stage: str) -> int:
        count = self._images
        return count * (count - 1) // 2 if stage in _PAIRWISE else count


def format_remaining_time(seconds: float | None) -> str:
    """Format seconds as text, for example ``about 3 min left``; empty for None."""
    if seconds is None:
        return ""
    if seconds < 60:
        return "less than a minute left"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} min left"
    return f"about {seconds / 3600:.1f} h left"


def _read_timings(file: Path) -> dict[str, float]:
    """Read the stage speeds of earlier runs; empty if the file is missing or damaged."""
    try:
        timings = json.loads(file.read_text(encoding="utf-8"))
        check_version(timings, FORMAT, file)
        return {stage: float(timings[stage]) for stage in _DEFAULT_SECONDS if stage in timings}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, InputError):
        return {}
