"""What a run is doing, how long it takes and how much memory: told to plugins and kept."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.reasons import explain

_PROC = Path("/proc/self")


@dataclass(frozen=True)
class StageRecord:
    """``peak_memory_mb``: resident memory of this process, None where it cannot be told."""

    seconds: float
    peak_memory_mb: float | None

    def after(self, earlier: StageRecord | None) -> StageRecord:
        """Of a stage that ran before too: the time of both, the larger peak."""
        if earlier is None:
            return self
        peaks = [p for p in (earlier.peak_memory_mb, self.peak_memory_mb) if p is not None]
        return StageRecord(earlier.seconds + self.seconds, max(peaks, default=None))


class Stages:
    """Receives the events of all rooms and passes them on to the hooks of all plugins."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._finished: dict[str, StageRecord] = {}
        self._running: dict[str, float] = {}
        self.warnings: list[str] = []
        """Warnings so far, for ``summary.json``."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """A stage of the pipeline."""
        self.stage_started(name, None)
        _reset_peak_memory()
        self._running[name] = time.perf_counter()
        try:
            yield
        finally:
            record = self._record(name)
            del self._running[name]
            self._finished[name] = record.after(self._finished.get(name))
            self.stage_finished(name, record.seconds)

    @contextmanager
    def step(self, name: str, total: int | None) -> Iterator[None]:
        """A step within a stage, of ``total`` units if known."""
        started = time.perf_counter()
        self.stage_started(name, total)
        try:
            yield
        finally:
            self.stage_finished(name, time.perf_counter() - started)

    def report(self) -> dict[str, StageRecord]:
        """The stages of the pipeline in order; one that still runs with what it took so far.

        Steps within a stage (features, depth, ...) are passed on to plugins and not kept.
        """
        return {**self._finished, **{name: self._record(name) for name in self._running}}

    def _record(self, name: str) -> StageRecord:
        return StageRecord(time.perf_counter() - self._running[name], peak_memory_mb())

    def notice(self, text: str) -> None:
        """Something that the user should know now, in one line."""
        self._registry.call_hook("mpsfm_notice", text=text)

    def warn(self, text: str) -> None:
        """Show a warning in one line, and record it for ``summary.json``."""
        self.warnings.append(text)
        self.notice(f"warning: {text}")

    def stage_started(self, stage: str, total: int | None) -> None:
        """A stage begins, with this many steps if known."""
        self._registry.call_hook("mpsfm_stage_started", stage=stage, total=total)

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Steps done so far."""
        self._registry.call_hook("mpsfm_stage_progress", stage=stage, done=done, total=total)

    def stage_finished(self, stage: str, seconds: float) -> None:
        """A stage ended."""
        self._registry.call_hook("mpsfm_stage_finished", stage=stage, seconds=seconds)

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """The mapper accepted an image."""
        self._registry.call_hook(
            "mpsfm_image_registered", name=name, registered=registered, total=total
        )

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Images or points have moved."""
        self._registry.call_hook("mpsfm_scene_changed", scene=scene)

    def image_rejected(self, name: str, reason: Reason) -> None:
        """The mapper tried an image and rejected it."""
        text = explain(reason).text
        self._registry.call_hook("mpsfm_image_rejected", name=name, reason=reason, text=text)


def _reset_peak_memory() -> None:
    """Forget the peak so far where the system can (Linux); elsewhere peaks count from the start."""
    with suppress(OSError):
        (_PROC / "clear_refs").write_text("5")


def peak_memory_mb() -> float | None:
    """Most memory that this process held, of a stage or else so far; None where nothing tells."""
    with suppress(OSError):
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    with suppress(ImportError):
        import resource

        unit = 1 << 20 if sys.platform == "darwin" else 1 << 10  # bytes there, kilobytes elsewhere
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return None
