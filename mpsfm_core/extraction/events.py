"""What the extraction tells the outside while it works."""

from __future__ import annotations

from typing import Protocol


class ExtractionEvents(Protocol):
    """Receives progress, always from the thread that called :func:`extract`."""

    def stage_started(self, stage: str, total: int | None) -> None: ...

    def stage_progress(self, stage: str, done: int, total: int) -> None: ...

    def stage_finished(self, stage: str, seconds: float) -> None: ...


class NullExtractionEvents:
    """Nobody listens."""

    def stage_started(self, stage: str, total: int | None) -> None:
        """Nothing."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        """Nothing."""

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Nothing."""
