"""Arrays in NPZ files, read within bounds and without running anything."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_BYTES = 4_000_000_000
"""Of the arrays of a file, or its own size where that is more: a small file can stand for any
number of zeros (ours: 16 bytes for each of the most pixels that a photo may have)."""


_LEVEL = 1
"""Of the compression: on depth maps 6, numpy's, takes twice the time to save 0.5 % (measured)."""


def write_npz(path: Path, **arrays: NDArray[Any]) -> None:
    """Write arrays by name, compressed; folders are made. Raises :class:`OSError`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name.

    Raises :class:`OSError` when the file cannot be read, :class:`ValueError` when it is damaged,
    too large, or something else.
    """
    with path.open("rb") as file:  # numpy leaves a damaged file open
        try:
            with zipfile.ZipFile(file) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
            if size > max(MAX_BYTES, path.stat().st_size):
                raise ValueError(f"unpacks to {size / 1e6:.0f} MB, {MAX_BYTES / 1e6:.0f} at most")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError):
            raise
        except Exception as error:  # the readers of zip files and arrays share no base class
            raise ValueError(f"is damaged: {type(error).__name__}: {error}") from error
