"""Checkpoints of the mapper, from which a resumed run gives bit-identical results."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from mpsfm_core.data.errors import DataError
from mpsfm_core.mapping.model_selection import MapperRun
from mpsfm_core.mapping.state import (
    CheckpointArrays,
    StateDict,
    Stateful,
    flatten_state,
    unflatten_state,
)


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
        """Return True if the mapper must save a checkpoint before it registers the next image."""

    def save(self, collect: Callable[[], CheckpointArrays], registered: int) -> None:
        """Save a checkpoint.

        Args:
            collect: Function that returns the arrays of the checkpoint, by name. The call computes
                pending depth maps, so its time counts as time for saving.
            registered: Number of images that are registered in the current component.
        """


class MapperProgress(NamedTuple):
    """Content of a mapper checkpoint."""

    runs: list[MapperRun]
    """Completed runs."""
    mapper: StateDict | None
    """State of the mapper of the interrupted run, or None if all mapper runs are complete."""


class Checkpointer:
    """Writer and reader of the checkpoints of the mapper."""

    def __init__(self, store: CheckpointStore | None) -> None:
        self._store = store

    def load(self) -> MapperProgress:
        """Load the mapper runs of the last checkpoint, or no runs without a readable checkpoint."""
        if self._store is not None and (arrays := self._store.load()) is not None:
            try:
                state = unflatten_state(arrays)
                runs = [MapperRun.from_state_dict(run) for run in state["runs"]]
                return MapperProgress(runs, state["mapper"])
            except (DataError, KeyError, TypeError, ValueError) as error:
                self._store.unreadable(str(error))
        return MapperProgress([], None)

    def save_if_due(self, runs: list[MapperRun], mapper: Stateful, num_registered: int) -> None:
        """Save a checkpoint of the mapper if the storage requests one."""
        if self._store is not None and self._store.due():
            self._save(runs, mapper, num_registered)

    def save_completed(self, runs: list[MapperRun]) -> None:
        """Save the completed mapper runs, in case a later pipeline stage is interrupted."""
        if self._store is not None:
            self._save(runs, None, max(run.size for run in runs))

    def _save(self, runs: list[MapperRun], mapper: Stateful | None, num_registered: int) -> None:
        def collect() -> CheckpointArrays:
            state = None if mapper is None else mapper.state_dict()
            return flatten_state({"runs": [run.state_dict() for run in runs], "mapper": state})

        assert self._store is not None
        self._store.save(collect, num_registered)
