"""Arrays that need not stay in memory: depth maps of many photos."""

from __future__ import annotations

import logging
import mmap
import tempfile
import threading
import weakref
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_log = logging.getLogger(__name__)
_T = TypeVar("_T", bound=np.generic)

IN_MEMORY = 2**29
"""Bytes that are kept in memory all the same: some 80 photos of the dense stage (ours)."""
_CHUNK = 2**26
"""Bytes of a file, at least: a mapped file costs a descriptor, of which a process may have 1024."""
_ALIGNMENT = 64


class DiskArrays:
    """Keeps arrays in memory up to a limit, and those that come then in unnamed temporary files.

    Arrays on disk are mapped into memory: the system reads them when they are needed and takes
    their memory back when it is short. The files are gone when the last array is, however the
    process ends. On a full disk everything stays in memory. May be used by several threads.

    ``folder``: where the files lie; it should be on a disk, as temporary folders of some systems
    are not.
    """

    def __init__(self, folder: Path, in_memory: int = IN_MEMORY) -> None:
        self._folder = folder
        self._left = in_memory
        self._lock = threading.Lock()
        self._chunk: mmap.mmap | None = None
        self._chunks: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        self._used = 0
        self._usable = True

    def store(self, array: NDArray[_T]) -> NDArray[_T]:
        """The same values, to be held instead of ``array``."""
        with self._lock:
            if array.nbytes <= self._left:
                self._left -= array.nbytes
                return array
            self._left = 0
            place = self._place(array.nbytes)
        if place is None:
            return array
        chunk, start = place
        kept = np.frombuffer(chunk, array.dtype, array.size, start).reshape(array.shape)
        kept[...] = array
        return kept

    def _place(self, size: int) -> tuple[mmap.mmap, int] | None:
        """A mapped file, and where in it so many bytes are free; None if there is none."""
        if not size or not self._usable:
            return None
        if self._chunk is None or self._used + size > len(self._chunk):
            self._release()
            self._chunk, self._used = self._new_chunk(max(size, _CHUNK)), 0
            if self._chunk is None:
                return None
        start = self._used
        self._used += -(-size // _ALIGNMENT) * _ALIGNMENT
        return self._chunk, start

    def _new_chunk(self, size: int) -> mmap.mmap | None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._folder) as file:
                file.write(bytes(size))  # a hole could not be filled once the disk is full
                file.flush()
                chunk = mmap.mmap(file.fileno(), size)
        except OSError as error:
            _log.warning("depth maps stay in memory: cannot write to %s: %s", self._folder, error)
            self._usable = False
            return None
        self._chunks.add(chunk)
        return chunk

    def _release(self) -> None:
        """Take back the memory of what is on disk, as no array of it is needed for long."""
        if hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
            for chunk in self._chunks:
                chunk.madvise(mmap.MADV_DONTNEED)
