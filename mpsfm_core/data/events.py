"""Progress events of a run, which the callback ``on_event`` receives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.mapping_problem import SceneState


@dataclass(frozen=True)
class Notice:
    """Message of one line for the user, such as the name of a chosen provider."""

    text: str


@dataclass(frozen=True)
class StageStarted:
    """Event at the start of a stage, such as ``"matching"``."""

    stage: str
    total: int | None
    """Number of steps of the stage, or None if the number is unknown."""


@dataclass(frozen=True)
class StageProgress:
    """Event after each finished step of a stage, with the number of finished steps."""

    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class StageFinished:
    """Event at the end of a stage."""

    stage: str
    seconds: float
    """Duration of the stage in seconds."""


@dataclass(frozen=True)
class ImageRegistered:
    """Event after the mapper registered an image."""

    name: str
    registered: int
    """Number of registered images of the component, including the new image."""
    total: int
    """Number of all images of the mapping problem."""


@dataclass(frozen=True)
class ImageRejected:
    """Event after the registration of an image failed, or after an image was removed."""

    name: str
    reason: Reason
    text: str
    """Reason of the rejection as text for the user."""


@dataclass(frozen=True)
class SceneChanged:
    """Event after poses or points changed during mapping."""

    scene: Callable[[], SceneState]
    """Function that returns a copy of the current poses and points."""


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
"""Function that receives the progress events of a run in the thread of the caller. An exception
that the function raises, such as :class:`~mpsfm_core.data.errors.Cancelled`, ends the run."""
