"""Files in the cache folder from which remote workers read the inputs of their tasks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from mpsfm_core.data.errors import OutputError
from mpsfm_core.extraction.executors import missing_cache_error
from mpsfm_core.mapping.state import StateDict, flatten_state, unflatten_state
from mpsfm_core.support.files import write_file
from mpsfm_core.support.npz import read_npz


@dataclass(frozen=True)
class TaskInputs:
    """Inputs of the tasks of a stage, in files that the main process writes and workers read."""

    cache: Path
    """Cache folder of the run, which all workers share."""
    stage: str

    def path(self, key: str) -> Path:
        """Return the file of the input with a key."""
        return self.cache / "mapping" / self.stage / f"{key}.npz"

    def store(self, key: str, state: StateDict) -> None:
        """Write an input for the workers.

        Raises:
            OutputError: the file cannot be written.
        """
        path, arrays = self.path(key), cast(Any, flatten_state(state))
        try:
            write_file(path, lambda file: np.savez(file, **arrays))
        except OSError as error:
            raise OutputError(
                f"cannot write {path}: {error}; free disk space or set runtime.cache_dir"
            ) from error

    def load(self, key: str) -> StateDict:
        """Read an input, identical to the stored input.

        Raises:
            InputError: this worker does not see the cache folder of the run.
        """
        try:
            return unflatten_state(read_npz(self.path(key)))
        except FileNotFoundError as error:
            raise missing_cache_error(self.cache) from error

    def forget(self, key: str) -> None:
        """Delete an input if it exists."""
        self.path(key).unlink(missing_ok=True)
