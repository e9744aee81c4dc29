"""When the state of the mapper may be kept, and how it is taken up again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import DataError
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.model_selection import Run
from mpsfm_core.mapping.state import Frozen, freeze, thaw

if TYPE_CHECKING:
    from mpsfm_core.mapping.mapper import Mapper


class Checkpoints(Protocol):
    """Keeps states; whoever implements it decides where, and which state fits a problem.

    States are taken between two images, and taking one changes nothing: results are the same
    however often that happens.
    """

    def load(self) -> Frozen | None:
        """The last state of a run with this problem and these options, None for a new start."""

    def unreadable(self, reason: str) -> None:
        """What :meth:`load` gave is of no use: there is a new start."""

    def due(self) -> bool:
        """Whether to keep the state now."""

    def save(self, state: Frozen, registered: int) -> None:
        """Keep a state; ``registered``: images in the group that is growing."""


class Keeper:
    """Takes and restores the states of the mapper."""

    def __init__(
        self, checkpoints: Checkpoints | None, problem: MappingProblem, events: MappingEvents
    ) -> None:
        self._checkpoints = checkpoints
        self._shared = (problem, events)

    def load(self) -> tuple[list[Run], Mapper | None]:
        """The runs that are finished, and the mapper of the one that is not; runs without a mapper
        are all that there will be."""
        if self._checkpoints is None or (frozen := self._checkpoints.load()) is None:
            return [], None
        try:
            runs, mapper = thaw(frozen, self._shared)
        except (DataError, TypeError, ValueError) as error:
            self._checkpoints.unreadable(str(error))
            return [], None
        return runs, mapper

    def save(self, runs: list[Run], mapper: Mapper) -> None:
        """Keep the state if it is time."""
        if self._checkpoints is not None and self._checkpoints.due():
            self._checkpoints.save(freeze((runs, mapper), self._shared), mapper.group.size)

    def finish(self, runs: list[Run]) -> None:
        """Keep what came out, for who is killed in what follows."""
        if self._checkpoints is not None:
            registered = max(run.size for run in runs)
            self._checkpoints.save(freeze((runs, None), self._shared), registered)
