"""Checkpoints of the mapper: an interrupted run continues with the same bits."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import DataError
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.model_selection import MapperRun
from mpsfm_core.mapping.serialization import CheckpointArrays, deserialize, serialize


class CheckpointStore(Protocol):
    """Storage of checkpoints; decides where they are kept and which one fits a problem.

    The mapper saves between two registrations. Saving changes no result.
    """

    def load(self) -> CheckpointArrays | None:
        """Return the last checkpoint of this problem and these options, or None."""

    def unreadable(self, reason: str) -> None:
        """Handle a checkpoint that cannot be restored; the mapper starts again."""

    def due(self) -> bool:
        """Return whether a checkpoint is to be saved now."""

    def save(self, state: CheckpointArrays, registered: int) -> None:
        """Save a checkpoint.

        Args:
            state: Arrays of the checkpoint.
            registered: Number of registered images of the current component.
        """


class MapperProgress(NamedTuple):
    """Content of a checkpoint."""

    runs: list[MapperRun]
    """Completed runs."""
    mapper: object | None
    """The mapper of the interrupted run; None with runs means that all runs are complete."""


class Checkpointer:
    """Saves and restores the progress of the mapper."""

    def __init__(
        self, store: CheckpointStore | None, problem: MappingProblem, events: MappingEvents
    ) -> None:
        self._store = store
        self._shared = (problem, events)

    def load(self) -> MapperProgress:
        """Restore the last checkpoint; empty progress if there is none or it is unreadable."""
        if self._store is None or (arrays := self._store.load()) is None:
            return MapperProgress([], None)
        try:
            runs, mapper = deserialize(arrays, self._shared)
        except (DataError, TypeError, ValueError) as error:
            self._store.unreadable(str(error))
            return MapperProgress([], None)
        return MapperProgress(runs, mapper)

    def save_if_due(self, progress: MapperProgress, num_registered: int) -> None:
        """Save a checkpoint if one is due."""
        if self._store is not None and self._store.due():
            self._save(progress, num_registered)

    def save_completed(self, runs: list[MapperRun]) -> None:
        """Save the completed runs, for an interruption of a later stage."""
        if self._store is not None:
            self._save(MapperProgress(runs, None), max(run.size for run in runs))

    def _save(self, progress: MapperProgress, num_registered: int) -> None:
        assert self._store is not None
        self._store.save(serialize(tuple(progress), self._shared), num_registered)
