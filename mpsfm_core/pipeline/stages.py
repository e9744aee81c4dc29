"""Stages of a run: forward events to plugins, record time and memory for the summary."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.events import (
    Event,
    EventCallback,
    ImageRegistered,
    ImageRejected,
    Notice,
    SceneChanged,
    StageFinished,
    StageProgress,
    StageStarted,
)
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.reasons import explain
from mpsfm_core.support.memory import release_free_memory

_PROC = Path("/proc/self")


@dataclass(frozen=True)
class StageRecord:
    """Duration and peak memory of a pipeline stage."""

    seconds: float
    peak_memory_mb: float | None
    """Peak resident memory of this process, or None if the operating system reports none."""

    def after(self, earlier: StageRecord | None) -> StageRecord:
        """Add the time of an earlier record of the stage, and use the higher memory peak."""
        if earlier is None:
            return self
        peaks = [p for p in (earlier.peak_memory_mb, self.peak_memory_mb) if p is not None]
        return StageRecord(earlier.seconds + self.seconds, max(peaks, default=None))


class _WarningRecorder(logging.Handler):
    """Handler that appends the text of logged warnings to a list, each text once."""

    def __init__(self, warnings: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._warnings = warnings

    def emit(self, record: logging.LogRecord) -> None:
        if (text := record.getMessage()) not in self._warnings:
            self._warnings.append(text)


class Stages:
    """Receiver of progress events of a run, which forwards events to callback and plugins."""

    def __init__(self, registry: Registry, on_event: EventCallback | None = None) -> None:
        self._registry = registry
        self._on_event = on_event or _ignore
        self._finished: dict[str, StageRecord] = {}
        self._running: dict[str, float] = {}
        self.warnings: list[str] = []
        """Warnings to the user so far, for ``summary.json``."""

    @contextmanager
    def recording_logged_warnings(self) -> Iterator[None]:
        """Append warnings that the package logs in the ``with`` block to :attr:`warnings`."""
        logger, recorder = logging.getLogger("mpsfm_core"), _WarningRecorder(self.warnings)
        logger.addHandler(recorder)
        try:
            yield
        finally:
            logger.removeHandler(recorder)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Record a pipeline stage that runs in the ``with`` block, and release its memory."""
        self.stage_started(name, None)
        reset_peak_memory()
        self._running[name] = time.perf_counter()
        try:
            yield
        finally:
            record = self._record(name)
            del self._running[name]
            self._finished[name] = record.after(self._finished.get(name))
            release_free_memory()
            self.stage_finished(name, record.seconds)

    @contextmanager
    def step(self, name: str, total: int | None) -> Iterator[None]:
        """Report a step of a stage that runs in the ``with`` block, with ``total`` work units."""
        started = time.perf_counter()
        self.stage_started(name, total)
        try:
            yield
        finally:
            self.stage_finished(name, time.perf_counter() - started)

    def report(self) -> dict[str, StageRecord]:
        """Return the duration and memory records of all stages, including running stages.

        Steps within a stage (features, depth, ...) are not recorded.
        """
        return {**self._finished, **{name: self._record(name) for name in self._running}}

    def _record(self, name: str) -> StageRecord:
        return StageRecord(time.perf_counter() - self._running[name], peak_memory_mb())

    def notice(self, text: str) -> None:
        """Show a message of one line to the user."""
        self._on_event(Notice(text))
        self._registry.call_hook("mpsfm_notice", text=text)

    def warn(self, text: str) -> None:
        """Show a warning in one line, and record it for ``summary.json``."""
        self.warnings.append(text)
        self.notice(f"warning: {text}")

    def stage_started(self, stage: str, total: int | None) -> None:
        """Forward the start of a stage and its number of steps to callback and plugins."""
        self._on_event(StageStarted(stage, total))
        self._registry.call_hook("mpsfm_stage_started", stage=stage, total=total)

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Forward the number of finished steps of a stage to callback and plugins."""
        self._on_event(StageProgress(stage, done, total))
        self._registry.call_hook("mpsfm_stage_progress", stage=stage, done=done, total=total)

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Forward the end of a stage to callback and plugins."""
        self._on_event(StageFinished(stage, seconds))
        self._registry.call_hook("mpsfm_stage_finished", stage=stage, seconds=seconds)

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Forward the registration of an image to callback and plugins."""
        self._on_event(ImageRegistered(name, registered, total))
        self._registry.call_hook(
            "mpsfm_image_registered", name=name, registered=registered, total=total
        )

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Forward a change of poses or points to callback and plugins."""
        self._on_event(SceneChanged(scene))
        self._registry.call_hook("mpsfm_scene_changed", scene=scene)

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Forward the rejection of an image, with the reason, to callback and plugins."""
        text = explain(reason).text
        self._on_event(ImageRejected(name, reason, text))
        self._registry.call_hook("mpsfm_image_rejected", name=name, reason=reason, text=text)


def _ignore(event: Event) -> None:
    """Ignore a progress event, as default of the callback ``on_event``."""


def reset_peak_memory() -> None:
    """Reset the peak memory of this process; only Linux can do so."""
    with suppress(OSError):
        (_PROC / "clear_refs").write_text("5")


def peak_memory_mb() -> float | None:
    """Return the peak resident memory of this process in MB, or None if unknown."""
    with suppress(OSError):
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    with suppress(ImportError):
        import resource

        unit = (
            1 << 20 if sys.platform == "darwin" else 1 << 10
        )  # macOS reports peak memory in bytes, other systems in kilobytes.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return None
