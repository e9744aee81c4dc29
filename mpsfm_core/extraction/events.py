"""Progress events of extraction."""

from __future__ import annotations

from typing import Protocol


class ExtractionEvents(Protocol):
    """Receiver of extraction progress; called in the thread that called ``extract``."""

    def stage_started(self, stage: str, total: int | None) -> None:
        """Report the start of a stage with ``total`` steps, or None if the number is unknown."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Report the number of finished steps of a stage."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Report the end of a stage and its duration in seconds."""


class NullExtractionEvents:
    """Receiver that ignores all extraction progress."""

    def stage_started(self, stage: str, total: int | None) -> None:
        """Ignore the event."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Ignore the event."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Ignore the event."""
