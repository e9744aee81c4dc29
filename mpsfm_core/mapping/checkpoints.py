"""Checkpoints of the mapper, from which a resumed run gives bit-identical results."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import DataError
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.model_selection import MapperRun
from mpsfm_core.mapping.serialization import CheckpointArrays, deserialize, serialize


class CheckpointStore(Protocol):
    """Interface of the storage that writes mapper checkpoints to disk and finds them again.

    The mapper saves checkpoints between two image registrations. Saving a checkpoint does not
    change the reconstruction.
    """

    def load(self) -> CheckpointArrays | None:
        """Return the last checkpoint of the same mapping problem and options, or None."""

    def unreadable(self, reason: str) -> None:
        """Handle a checkpoint that cannot be restored, before the mapper restarts from scratch."""

    def due(self) -> bool:
        """Return True if the mapper shall save a checkpoint now."""

    def save(self, state: CheckpointArrays, registered: int) -> None:
        """Save a checkpoint.

        Args:
            state: Arrays of the mapper checkpoint, by name.
            registered: Number of images that are registered in the current component.
        """


class MapperProgress(NamedTuple):
    """Content of a mapper checkpoint."""

    runs: list[MapperRun]
    """Completed runs."""
    mapper: object | None
    """The mapper of the interrupted run. The interrupted run is None if all mapper runs are
    complete."""


class Checkpointer:
    """Writer and reader of the checkpoints of the mapper."""

    def __init__(
        self, store: CheckpointStore | None, problem: MappingProblem, events: MappingEvents
    ) -> None:
        self._store = store
        self._shared = (problem, events)

    def load(self) -> MapperProgress:
        """Restore the last mapper checkpoint, or return empty progress if none can be read."""
        if self._store is None or (arrays := self._store.load()) is None:
            return MapperProgress([], None)
        try:
            runs, mapper = deserialize(arrays, self._shared)
        except (DataError, TypeError, ValueError) as error:
            self._store.unreadable(str(error))
            return MapperProgress([], None)
        return MapperProgress(runs, mapper)

    def save_if_due(self, progress: MapperProgress, num_registered: int) -> None:
        """Save a checkpoint of the mapper if the storage requests one."""
        if self._store is not None and self._store.due():
            self._save(progress, num_registered)

    def save_completed(self, runs: list[MapperRun]) -> None:
        """Save the completed mapper runs, in case a later pipeline stage is interrupted."""
        if self._store is not None:
            self._save(MapperProgress(runs, None), max(run.size for run in runs))

    def _save(self, progress: MapperProgress, num_registered: int) -> None:
        assert self._store is not None
        self._store.save(serialize(tuple(progress), self._shared), num_registered)
