"""Progress events of extraction."""

from __future__ import annotations

from typing import Protocol


class ExtractionEvents(Protocol):
    """Receives progress, always in the thread that called :func:`extract`."""

    def stage_started(self, stage: str, total: int | None) -> None:
        """Receive the start of a stage with ``total`` steps, None if unknown."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Receive the number of finished steps."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Receive the end of a stage."""


class NullExtractionEvents:
    """Ignores all events."""

    def stage_started(self, stage: str, total: int | None) -> None:
        """Ignore the event."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Ignore the event."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Ignore the event."""
