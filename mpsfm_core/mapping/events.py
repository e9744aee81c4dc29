"""Interface of the progress events that the mapper emits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from mpsfm_core.data import SceneState
from mpsfm_core.data.decisions import Reason


class MappingEvents(Protocol):
    """Receiver of the mapper's progress events, which the pipeline forwards to plugins."""

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Handle the registration of an image as the ``registered``-th image of its component."""

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Handle the failed registration or the deregistration of an image."""

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Handle a change of poses or points; the function ``scene`` copies the reconstruction."""


class NullMappingEvents:
    """Receiver that ignores all events of the mapper."""

    def image_registered(self, name: str, registered: int, total: int) -> None:
        """Ignore the event."""

    def image_rejected(self, name: str, reason: Reason) -> None:
        """Ignore the event."""

    def scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Ignore the event."""
