"""Interface for progress events of the mapper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason


class MappingEvents(Protocol):
    """Receiver of progress events; the pipeline forwards them to plugins and progress bars."""

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Handle the registration of an image, the ``registered``-th of its component."""

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Handle a failed registration, or the deregistration of an image."""

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Handle a change of poses or points; calling ``scene`` copies the current state."""


class NullMappingEvents:
    """Receiver that ignores all events."""

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Ignore the event."""

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Ignore the event."""

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Ignore the event."""
