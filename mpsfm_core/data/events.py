"""Progress events of a run, which the callback ``on_event`` receives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.mapping_problem import SceneState


@dataclass(frozen=True)
class Notice:
    """One line of text for the user, such as the name of a chosen provider."""

    text: str


@dataclass(frozen=True)
class StageStarted:
    """Start of a stage, such as ``"matching"``."""

    stage: str
    total: int | None
    """Number of steps of the stage, or None if it is unknown."""


@dataclass(frozen=True)
class StageProgress:
    """Number of finished steps of a stage."""

    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class StageFinished:
    """End of a stage."""

    stage: str
    seconds: float
    """Duration of the stage in seconds."""


@dataclass(frozen=True)
class ImageRegistered:
    """Registration of an image by the mapper."""

    name: str
    registered: int
    """Number of registered images of the component, with this image."""
    total: int
    """Number of all images."""


@dataclass(frozen=True)
class ImageRejected:
    """Failed registration of an image, or its removal from the model."""

    name: str
    reason: Reason
    text: str
    """The reason in words."""


@dataclass(frozen=True)
class SceneChanged:
    """Change of poses or points during mapping."""

    scene: Callable[[], SceneState]
    """Function that copies the current reconstruction."""


Event = (
    Notice
    | StageStarted
    | StageProgress
    | StageFinished
    | ImageRegistered
    | ImageRejected
    | SceneChanged
)

EventCallback = Callable[[Event], None]
"""Function that receives the events of a run in the thread of the caller. An exception that the
function raises, such as :class:`~mpsfm_core.data.errors.Cancelled`, ends the run."""
