"""Mutated copies of well-formed files, and processes that read them."""

from __future__ import annotations

import os
import random
import resource
import signal
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2

from mpsfm_core.data.errors import MpsfmError

LIMIT_S = 10
"""Maximum CPU time in seconds of a reader for a file; a longer time counts as a hang."""
MEMORY = 1 << 30
"""Maximum bytes that a reader may allocate for a file of some kilobytes."""

_TOKENS = (
    *(b"0", b"-1", b"1e309", b"nan", b"99999999999999999999", b"18446744073709551615", b"1_0"),
    *(
        b"\x00",
        b"\xff\xfe",
        b"\xc3",
        b"[" * 500,
        b"{" * 500,
        b"'",
        b'"',
        b"\n",
        b"- ",
        b"? ",
        b"!!x",
    ),
    *(b"&a [*a]", b"../../../etc/passwd", b"*b", b"null", b"true", b"1:", b"%", b"\t"),
    *(b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8),
)

WELL_FORMED = -1
"""Number of the case with the unmutated file, which the reader must accept."""

Reader = Callable[[Path], object]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Mutate a file: truncate, overwrite, repeat or delete bytes, or insert tokens."""
    kind = rng.randrange(6)
    if kind == 0:
        return data[: rng.randrange(len(data) + 1)]
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        place = rng.randrange(len(made) + 1)
        if kind == 1 and place < len(made):
            made[place] ^= 1 << rng.randrange(8)
        elif kind == 2:
            made[place : place + rng.randrange(1, 9)] = rng.randbytes(rng.randrange(9))
        elif kind == 3:
            start = rng.randrange(len(made) + 1)
            made[place:place] = made[start : start + rng.randrange(1, 65)]
        elif kind == 4:
            token = rng.choice(_TOKENS)
            made[place : place + rng.choice((0, len(token)))] = token
        else:
            del made[place : place + rng.randrange(1, 33)]
    return bytes(made)


def failures(reader: Reader, name: str, seed: bytes, numbers: range) -> Iterator[str]:
    """Read mutated files in a subprocess and yield a line for each fault of the reader.

    A fault is an exception other than `MpsfmError`, a crash, a hang, or too much memory.

    The calling process should not run OpenCV threads just before. A thread that is about to end can
    hold a lock of OpenCV during the fork, which blocks the subprocess forever.
    """
    start = numbers.start
    while start < numbers.stop:
        died, end = yield from _in_process(reader, name, seed, range(start, numbers.stop))
        if died:
            yield f"{name} case {end}: {died}"
        start = end + 1


def case(name: str, seed: bytes, number: int) -> bytes:
    """Return the bytes of a mutation case, reproducible by its number."""
    if number == WELL_FORMED:
        return seed
    return mutated(seed, random.Random(f"{name} {number}"))


def _in_process(reader: Reader, name: str, seed: bytes, numbers: range):
    receiver, sender = os.pipe()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # A fork waits forever for the threads that OpenCV had before.
    child = os.fork()
    if child == 0:
        os.close(receiver)
        try:
            _read_all(reader, name, seed, numbers, sender)
        finally:
            os._exit(0)
    cv2.setNumThreads(threads)
    os.close(sender)
    last = numbers.start
    with os.fdopen(receiver, "r") as lines:
        for line in lines:
            number, _, fault = line.rstrip("\n").partition(" ")
            last = int(number)
            if fault:
                yield f"{name} case {last}: {fault}"
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        what = os.WTERMSIG(status)
        hangs = what in (signal.SIGPROF, signal.SIGALRM)
        return ("it hangs" if hangs else f"killed by signal {what}"), last
    return "", numbers.stop


def _read_all(reader: Reader, name: str, seed: bytes, numbers: range, sender: int) -> None:
    with Path("/proc/self/statm").open() as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            os.write(sender, f"{number} \n".encode())
            path = Path(folder) / str(number) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(case(name, seed, number))
            signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
            signal.alarm(10 * LIMIT_S)  # Wall time limit for a reader that blocks.
            try:
                reader(path)
            except BaseException as error:
                if number == WELL_FORMED or not isinstance(error, MpsfmError):
                    place = traceback.extract_tb(error.__traceback__)[-1]
                    text = f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"
                    os.write(sender, f"{number} {' '.join(text.split())[:300]}\n".encode())
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
