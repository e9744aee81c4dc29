"""Provider instance whose construction and calls are observed for contract checks."""

from __future__ import annotations

import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpsfm_core.testing.process_state import (
    ProcessSettings,
    known_process_state,
    read_process_state,
)


@dataclass(frozen=True)
class ObservedInstance:
    """Provider instance and everything that its construction and its calls did."""

    provider: Any
    """The provider instance."""
    answers: tuple[Any, ...]
    """Output of each call."""
    construction_s: float
    """Time in seconds to construct the provider."""
    call_s: tuple[float, float]
    """Time in seconds of the first and of the last call."""
    changes: dict[str, str]
    """Name of the global setting that the construction and the first call changed, or an empty
    text."""
    printed: list[str]
    """Lines on standard output."""
    connections: list[str]
    """Addresses of requested network connections and name look-ups."""


def observe_instance(
    create: Callable[[], Any], calls: Sequence[Callable[[Any], Any]], settings: ProcessSettings
) -> ObservedInstance:
    """Construct a provider and call the provider several times while observing the process.

    The construction and the first call run with known random numbers, threads and environment
    variables, so that every change is visible. Later calls run with the settings of a
    reconstruction.

    Args:
        create: Function that constructs the provider.
        calls: At least two functions that call a provider and return the output.
        settings: Settings of the process before any instance of the provider was created.
    """
    with _capture_output() as printed, _record_connections() as connections:
        with known_process_state(settings):
            before = read_process_state()
            started = time.perf_counter()
            provider = create()
            construction_s = time.perf_counter() - started
            constructed = read_process_state()
            started = time.perf_counter()
            answers = [calls[0](provider)]
            first_s = time.perf_counter() - started
            changes = {
                "constructing the provider": before.changes(
                    constructed, without_torch_numbers=True
                ),
                "a call of the provider": constructed.changes(read_process_state()),
            }
        for call in calls[1:]:
            started = time.perf_counter()
            answers.append(call(provider))
            last_s = time.perf_counter() - started
    return ObservedInstance(
        provider, tuple(answers), construction_s, (first_s, last_s), changes, printed, connections
    )


@contextmanager
def _record_connections() -> Iterator[list[str]]:
    """Collect the addresses of network connections and name look-ups by Python code."""
    addresses: list[str] = []

    def record(original: Callable[..., Any]) -> Callable[..., Any]:
        def connect(*arguments: Any, **named: Any) -> Any:
            address = next((a for a in arguments if not isinstance(a, socket.socket)), "")
            addresses.append(str(address))
            return original(*arguments, **named)

        return connect

    replaced: list[tuple[Any, str]] = [(socket.socket, "connect"), (socket.socket, "connect_ex")]
    replaced += [(socket.socket, "sendto"), (socket, "getaddrinfo"), (socket, "create_connection")]
    originals = [(owner, name, getattr(owner, name)) for owner, name in replaced]
    for owner, name, original in originals:
        setattr(owner, name, record(original))
    try:
        yield addresses
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


@contextmanager
def _capture_output() -> Iterator[list[str]]:
    """Collect the lines that Python or native code writes to standard output."""
    lines: list[str] = []
    sys.stdout.flush()
    saved = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        stdout = sys.stdout
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - descriptor 1 must stay open
        try:
            yield lines
        finally:
            sys.stdout.flush()
            sys.stdout = stdout
            os.dup2(saved, 1)
            os.close(saved)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()
