"""Messages between two processes: a text over a pipe, arrays through memory that both map.

Either side has one file for what it sends, in memory where the system has a file system there,
which grows as needed and is used again for every message: a message is read before the next one is
written, as one side asks and the other answers.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
from pathlib import Path
from typing import IO, Any

from mpsfm_core.environments.codec import Packed, unpack

_IN_MEMORY = Path("/dev/shm")
_HEADER = struct.Struct("<QQ")
_LARGEST_TEXT = 1 << 28
_EMPTY = memoryview(b"")


class Closed(Exception):
    """The other side is gone."""


class Channel:
    """One end. ``folder``: of both files; ``own``, ``other``: names of what either side sends.

    ``copy``: whether arrays that are received are copies. Without, they are valid until the next
    message arrives.
    """

    def __init__(
        self, reader: IO[bytes], writer: IO[bytes], folder: Path, own: str, other: str, copy: bool
    ) -> None:
        self._reader, self._writer = reader, writer
        self._own, self._other = _Block(folder / own), _Block(folder / other)
        self._copy = copy

    def send(self, value: Any) -> None:
        """Send a value; raises :class:`Closed` when nobody is there."""
        packed = Packed(value)
        if packed.size:
            packed.write(self._own.for_writing(packed.size))
        try:
            self._writer.write(_HEADER.pack(len(packed.text), packed.size) + packed.text)
            self._writer.flush()
        except (OSError, ValueError) as error:
            raise Closed from error

    def receive(self) -> Any:
        """The next value; raises :class:`Closed` when none comes any more."""
        length, size = _HEADER.unpack(self._read(_HEADER.size))
        if length > _LARGEST_TEXT:
            raise Closed  # somebody else writes into the pipe
        text = self._read(length)
        block = self._other.for_reading(size) if size else _EMPTY
        return unpack(text, block, self._copy)

    def close(self) -> None:
        """Give the memory back; the files go with their folder."""
        self._own.close()
        self._other.close()

    def _read(self, count: int) -> bytes:
        data = self._reader.read(count)
        if data is None or len(data) < count:
            raise Closed
        return data


class _Block:
    """A file of bytes that both processes map."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._map: mmap.mmap | None = None
        self._size = 0

    def for_writing(self, size: int) -> memoryview:
        """Bytes to write to, made larger if need be; a full disk is found out here."""
        if size > self._size:
            self.close()
            with self._path.open("a+b") as file:
                reserve(file.fileno(), size)
            self._open(size)
        assert self._map is not None
        return memoryview(self._map)[:size]

    def for_reading(self, size: int) -> memoryview:
        """What the other side wrote."""
        if size > self._size:
            self.close()
            self._open(self._path.stat().st_size)
        assert self._map is not None
        return memoryview(self._map)[:size]

    def close(self) -> None:
        """Forget the map; it lives as long as arrays that look into it."""
        self._map, self._size = None, 0

    def _open(self, size: int) -> None:
        with self._path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), size)
        self._size = size


def reserve(descriptor: int, size: int) -> None:
    """Make a file this long, with room for all of it: what is missing when a map is written to
    would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.truncate(descriptor, size)


def memory_folder(needed: int) -> tempfile.TemporaryDirectory[str]:
    """A folder for the files, in memory where ``needed`` bytes fit there."""
    place = None
    if _IN_MEMORY.is_dir() and os.access(_IN_MEMORY, os.W_OK):
        status = os.statvfs(_IN_MEMORY)
        if status.f_bavail * status.f_frsize > needed:
            place = str(_IN_MEMORY)
    return tempfile.TemporaryDirectory(prefix="mpsfm-", dir=place)
