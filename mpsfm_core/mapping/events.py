"""What the mapper tells the outside while it works."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason


class MappingEvents(Protocol):
    """Receives progress; the pipeline forwards it to plugins and progress bars."""

    def image_registered(self, name: str, registered: int, total: int) -> None: ...

    def image_rejected(self, name: str, reason: Reason) -> None: ...

    def scene_changed(self, scene: Callable[[], SceneState]) -> None: ...


class NullMappingEvents:
    """Nobody listens."""

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Nothing."""

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Nothing."""

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Nothing."""
