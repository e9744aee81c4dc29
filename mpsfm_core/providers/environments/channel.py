"""Messages between two processes: a text over a pipe, arrays through memory that both map.

As one side asks and the other answers, either says with its message into which of its blocks the
next one is to be written. A block is a file, in memory where the system has a file system there,
which grows as needed and is used again: fresh memory costs more than the copy into it.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
import weakref
from pathlib import Path
from typing import IO, Any

import numpy as np

from mpsfm_core.data import UInt8
from mpsfm_core.providers.environments.codec import EncodedMessage, decode_message

_IN_MEMORY = Path("/dev/shm")
_HEADER = struct.Struct("<IIQ")
"""Bytes of text, number of the block for the answer, bytes of arrays. As of all versions of the
protocol where the number is 0, so that the greeting is understood, which says the version."""
_LARGEST_TEXT = 1 << 28
_EMPTY = np.empty(0, dtype=np.uint8)


class ChannelClosed(Exception):
    """The other side is gone."""


class Channel:
    """One end. ``folder``: of the files; ``own``, ``other``: beginnings of the names of what either
    side sends.

    ``lent``: how many messages can be looked into at once. Arrays that are received look into their
    message's block for as long as they live; when all blocks are looked into, arrays are copies.
    None: arrays are valid until the next message arrives.
    """

    def __init__(
        self,
        reader: IO[bytes],
        writer: IO[bytes],
        folder: Path,
        own: str,
        other: str,
        lent: int | None = None,
    ) -> None:
        self._reader, self._writer = reader, writer
        self._own, self._other = folder / own, folder / other
        self._written: dict[int, _Block] = {}
        self._inbox = [_Block(Path(f"{self._other}{i}")) for i in range(1 + (lent or 0))]
        self._lends = lent is not None
        self._target, self._wanted = 0, 0

    def send(self, value: Any) -> None:
        """Send a value; raises :class:`ChannelClosed` when nobody is there."""
        packed = EncodedMessage(value)
        if packed.size:
            block = self._written.get(self._target) or _Block(Path(f"{self._own}{self._target}"))
            self._written[self._target] = block
            packed.write(block.for_writing(packed.size))
        # the last block, whose content is copied, where all others are looked into
        free = (i for i, block in enumerate(self._inbox) if not block.looked_into)
        self._wanted = next(free, len(self._inbox) - 1)
        try:
            header = _HEADER.pack(len(packed.text), self._wanted, packed.size)
            self._writer.write(header + packed.text)
            self._writer.flush()
        except (OSError, ValueError) as error:
            raise ChannelClosed from error

    def receive(self) -> Any:
        """The next value; raises :class:`ChannelClosed` when none comes any more."""
        length, self._target, size = _HEADER.unpack(self._read(_HEADER.size))
        if length > _LARGEST_TEXT:
            raise ChannelClosed  # somebody else writes into the pipe
        text = self._read(length)
        block = self._inbox[self._wanted].for_reading(size) if size else _EMPTY
        return decode_message(
            text, block, copy=self._lends and self._wanted == len(self._inbox) - 1
        )

    def close(self) -> None:
        """Give the memory back; the files go with their folder."""
        for block in (*self._written.values(), *self._inbox):
            block.close()

    def _read(self, count: int) -> bytes:
        data = self._reader.read(count)
        if data is None or len(data) < count:
            raise ChannelClosed
        return data


class _Block:
    """A file of bytes that both processes map."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._map: mmap.mmap | None = None
        self._size = 0
        self._read: weakref.ref[UInt8] | None = None

    @property
    def looked_into(self) -> bool:
        """Whether an array of what was read lives."""
        return self._read is not None and self._read() is not None

    def for_writing(self, size: int) -> memoryview:
        """Bytes to write to, made larger if need be; a full disk is found out here."""
        if size > self._size:
            self.close()
            with self._path.open("a+b") as file:
                reserve_space(file.fileno(), size)
            self._open(size)
        assert self._map is not None
        return memoryview(self._map)[:size]

    def for_reading(self, size: int) -> UInt8:
        """What the other side wrote."""
        if size > self._size:
            self.close()
            self._open(self._path.stat().st_size)
        assert self._map is not None
        content = np.frombuffer(self._map, dtype=np.uint8, count=size)
        self._read = weakref.ref(content)  # views of it keep it alive
        return content

    def close(self) -> None:
        """Forget the map; it lives as long as arrays that look into it."""
        self._map, self._size = None, 0

    def _open(self, size: int) -> None:
        with self._path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), size)
        self._size = size


def reserve_space(descriptor: int, size: int) -> None:
    """Make a file this long, with room for all of it: what is missing when a map is written to
    would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.truncate(descriptor, size)


def create_shared_folder(needed: int) -> tempfile.TemporaryDirectory[str]:
    """A folder for the files, in memory where ``needed`` bytes fit there."""
    place = None
    if _IN_MEMORY.is_dir() and os.access(_IN_MEMORY, os.W_OK):
        status = os.statvfs(_IN_MEMORY)
        if status.f_bavail * status.f_frsize > needed:
            place = str(_IN_MEMORY)
    return tempfile.TemporaryDirectory(prefix="mpsfm-", dir=place)
