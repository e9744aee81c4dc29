"""Message channel between two processes, with a pipe for text and shared memory for arrays.

A block of shared memory is a memory-mapped file, on an in-memory file system if there is one. A
block grows as needed and is reused, because allocating shared memory takes longer than copying
arrays into existing memory.
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
"""Binary format of the message header: number of text bytes, index of the shared memory block for
the reply, and number of array bytes. The header is the same in all versions of the message
protocol, so both processes can read the version in the first message."""
_LARGEST_TEXT = 1 << 28
_EMPTY = np.empty(0, dtype=np.uint8)


class ChannelClosed(Exception):
    """Error raised if the process at the other end of a message channel has ended."""


class Channel:
    """One end of the message channel between two processes.

    Each message has the index of the shared memory block for the arrays of the reply.
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
        """Open one end of the channel on a pair of pipes.

        Args:
            reader: Pipe from which this end of the channel reads messages.
            writer: Pipe to which this end of the channel writes messages.
            folder: Folder of the shared memory files of both processes.
            own: File name prefix of the shared memory blocks that this end of the channel writes.
            other: File name prefix of the shared memory blocks that the other end of the channel
                writes.
            lent: Number of received messages whose arrays may be alive at the same time without a
                copy. Received arrays are numpy views of a shared memory block, or copies if all
                blocks are in use. If the number is None, received arrays are never copied and are
                valid until the next message.
        """
        self._reader, self._writer = reader, writer
        self._own, self._other = folder / own, folder / other
        self._written: dict[int, _Block] = {}
        self._inbox = [_Block(Path(f"{self._other}{i}")) for i in range(1 + (lent or 0))]
        self._lends_blocks = lent is not None
        self._target, self._announced = 0, 0

    def send(self, value: Any) -> None:
        """Send a value to the other process.

        Raises:
            ChannelClosed: The process at the other end of the channel has ended.
        """
        packed = EncodedMessage(value)
        if packed.size:
            block = self._written.get(self._target) or _Block(Path(f"{self._own}{self._target}"))
            self._written[self._target] = block
            packed.write(block.for_writing(packed.size))
        # If all shared memory blocks are in use, the last block receives the arrays of the reply,
        # which are then copied.
        free = (i for i, block in enumerate(self._inbox) if not block.in_use)
        self._announced = next(free, len(self._inbox) - 1)
        try:
            header = _HEADER.pack(len(packed.text), self._announced, packed.size)
            self._writer.write(header + packed.text)
            self._writer.flush()
        except (OSError, ValueError) as error:
            raise ChannelClosed from error

    def receive(self) -> Any:
        """Receive the next message from the other process.

        Raises:
            ChannelClosed: The process at the other end of the channel has ended.
        """
        length, self._target, size = _HEADER.unpack(self._read(_HEADER.size))
        if length > _LARGEST_TEXT:
            # Other code in the worker process wrote to the pipe, so these bytes are no message
            # header.
            raise ChannelClosed
        text = self._read(length)
        block = self._inbox[self._announced].for_reading(size) if size else _EMPTY
        return decode_message(
            text, block, copy=self._lends_blocks and self._announced == len(self._inbox) - 1
        )

    def close(self) -> None:
        """Unmap the shared memory blocks, without deleting their files."""
        for block in (*self._written.values(), *self._inbox):
            block.close()

    def _read(self, count: int) -> bytes:
        data = self._reader.read(count)
        if data is None or len(data) < count:
            raise ChannelClosed
        return data


class _Block:
    """Block of shared memory, which is a file that both processes map into memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._map: mmap.mmap | None = None
        self._size = 0
        self._read: weakref.ref[UInt8] | None = None

    @property
    def in_use(self) -> bool:
        """True while a numpy array that refers to the shared memory block is alive."""
        return self._read is not None and self._read() is not None

    def for_writing(self, size: int) -> memoryview:
        """Return a writable buffer of ``size`` bytes, growing the shared memory file if needed."""
        if size > self._size:
            self.close()
            with self._path.open("a+b") as file:
                reserve_space(file.fileno(), size)
            self._open(size)
        assert self._map is not None
        return memoryview(self._map)[:size]

    def for_reading(self, size: int) -> UInt8:
        """Return the bytes that the other process wrote to the shared memory block."""
        if size > self._size:
            self.close()
            self._open(self._path.stat().st_size)
        assert self._map is not None
        content = np.frombuffer(self._map, dtype=np.uint8, count=size)
        # The weak reference is alive while numpy views of ``content`` are in use.
        self._read = weakref.ref(content)
        return content

    def close(self) -> None:
        """Release the memory map; the memory is unmapped when no array refers to it."""
        self._map, self._size = None, 0

    def _open(self, size: int) -> None:
        with self._path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), size)
        self._size = size


def reserve_space(descriptor: int, size: int) -> None:
    """Reserve space on the file system for a shared memory file of the given size.

    Without reserved space, writing to a memory-mapped file on a full file system would kill the
    process.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.truncate(descriptor, size)


def create_shared_folder(needed: int) -> tempfile.TemporaryDirectory[str]:
    """Create a folder for shared memory files, if possible on ``/dev/shm``.

    Args:
        needed: Bytes that must be free on ``/dev/shm``; otherwise the temporary folder is used.
    """
    place = None
    if _IN_MEMORY.is_dir() and os.access(_IN_MEMORY, os.W_OK):
        status = os.statvfs(_IN_MEMORY)
        if status.f_bavail * status.f_frsize > needed:
            place = str(_IN_MEMORY)
    return tempfile.TemporaryDirectory(prefix="mpsfm-", dir=place)
