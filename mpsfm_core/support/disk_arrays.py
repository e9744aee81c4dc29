"""Storage of large arrays in memory-mapped temporary files.

A run chooses the folder of the files once with :func:`store_on_disk`, and objects that are created
in the run keep their arrays in the storage that :func:`current_store` returns.
"""

from __future__ import annotations

import logging
import mmap
import os
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import fields
from pathlib import Path
from typing import IO, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.support.memory import release_free_memory

_log = logging.getLogger(__name__)
_T = TypeVar("_T", bound=np.generic)
_Item = TypeVar("_Item")

MEMORY_LIMIT = 2**26
"""Maximum bytes of arrays in memory, so that small problems need no file. [ours]"""
_MIN_FILE_BYTES = 2**26
"""Minimum size of a temporary file in bytes, because a process may open only 1024 files."""
_ALIGNMENT = 64
"""Alignment of arrays in a file, in bytes."""


class ArrayStore(Protocol):
    """Callable that stores a large array in memory or on disk."""

    def __call__(self, array: NDArray[_T]) -> NDArray[_T]:
        """Store an array in memory or on disk, and return a stored array with equal values."""
        ...


def store_in_memory(array: NDArray[_T]) -> NDArray[_T]:
    """Return the array unchanged, as an :class:`ArrayStore` without files."""
    return array


def is_on_disk(array: NDArray[np.generic]) -> bool:
    """Return whether an array is in a memory-mapped file of :class:`DiskArrays`."""
    base: object = array
    while isinstance(base, np.ndarray | memoryview):
        base = base.base if isinstance(base, np.ndarray) else base.obj
    return isinstance(base, mmap.mmap)


def store_fields(item: _Item, store: ArrayStore) -> _Item:
    """Return a copy of a dataclass instance whose arrays are stored."""
    values = {field.name: getattr(item, field.name) for field in fields(item)}  # type: ignore[arg-type]
    copied = copy(item)  # The values do not change, so they are not checked again.
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            object.__setattr__(copied, name, store(value))
    return copied


_STORE: ContextVar[ArrayStore] = ContextVar("array store", default=store_in_memory)


def current_store() -> ArrayStore:
    """Return the storage of large arrays of the calling thread, by default memory."""
    return _STORE.get()


@contextmanager
def store_on_disk(folder: Path, in_memory: int = MEMORY_LIMIT) -> Iterator[None]:
    """Store large arrays in temporary files inside a ``with`` block, see :class:`DiskArrays`."""
    token = _STORE.set(DiskArrays(folder, in_memory).store)
    try:
        yield
    finally:
        _STORE.reset(token)


class DiskArrays:
    """Storage of arrays in memory up to a limit, then in unnamed temporary files.

    Files are memory-mapped, so the operating system reads pages on demand and frees them when
    memory is short. A temporary file is deleted when its last array is freed or the process ends.
    If the disk is full, arrays stay in memory. Several threads may store arrays at the same time.

    Args:
        folder: Folder of the temporary files. The folder should be on a disk, because the system's
            temporary folder may be in memory.
        in_memory: Maximum bytes of arrays in memory.
    """

    def __init__(self, folder: Path, in_memory: int = MEMORY_LIMIT) -> None:
        self._folder = folder
        self._memory_left = in_memory
        self._lock = threading.Lock()
        self._chunk: mmap.mmap | None = None
        self._chunks: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        self._used = 0
        self._usable = True

    def store(self, array: NDArray[_T]) -> NDArray[_T]:
        """Keep an array in memory, or copy the array to a file if the memory limit is reached.

        Returns:
            The array or its copy in the file. The copy is read-only if the array is.
        """
        with self._lock:
            if array.nbytes <= self._memory_left:
                self._memory_left -= array.nbytes
                return array
            self._memory_left = 0
            allocation = self._allocate(array.nbytes)
        if allocation is None:
            return array
        chunk, start = allocation
        stored = np.frombuffer(chunk, array.dtype, array.size, start).reshape(array.shape)
        stored[...] = array
        # Kernels are compiled separately for writable and read-only arrays.
        stored.flags.writeable = array.flags.writeable
        return stored

    def _allocate(self, size: int) -> tuple[mmap.mmap, int] | None:
        """Reserve bytes in a mapped file; return file and offset, None without disk space."""
        if not size or not self._usable:
            return None
        if self._chunk is None or self._used + size > len(self._chunk):
            self._release_pages()
            release_free_memory()
            self._chunk, self._used = self._create_file(max(size, _MIN_FILE_BYTES)), 0
            if self._chunk is None:
                return None
        start = self._used
        self._used += -(-size // _ALIGNMENT) * _ALIGNMENT
        return self._chunk, start

    def _create_file(self, size: int) -> mmap.mmap | None:
        """Create and map an unnamed file; return None if the disk is full or not writable."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._folder) as file:
                _reserve(file, size)
                chunk = mmap.mmap(file.fileno(), size)
        except OSError as error:
            _log.warning(
                "cannot write temporary files to %s (%s): depth maps stay in memory",
                self._folder,
                error,
            )
            self._usable = False
            return None
        self._chunks.add(chunk)
        return chunk

    def _release_pages(self) -> None:
        """Free the memory of mapped pages; the operating system reads them again on demand."""
        if hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
            for chunk in self._chunks:
                chunk.madvise(mmap.MADV_DONTNEED)


def _reserve(file: IO[bytes], size: int) -> None:
    """Reserve disk space for an empty file, because writes to a mapped sparse file could fail."""
    if hasattr(os, "posix_fallocate"):  # not on macOS and Windows
        os.posix_fallocate(file.fileno(), 0, size)
    else:
        file.write(bytes(size))
        file.flush()
