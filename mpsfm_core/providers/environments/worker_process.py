"""Client that starts a worker process in another environment and sends requests to it."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mpsfm_core.data import errors
from mpsfm_core.data.errors import DataError, MpsfmError, ProviderError
from mpsfm_core.data.options import SettingProblem, SettingsError
from mpsfm_core.providers import API_VERSION
from mpsfm_core.providers.environments.channel import Channel, ChannelClosed, create_shared_folder

PROTOCOL = 3
"""Version of the message protocol, which must be the same in client and worker process."""

_MODULE = "mpsfm_core.providers.environments.worker"
_START_TIMEOUT_S = 120.0
"""Time limit in seconds for a worker process to import mpsfm-core, perhaps from a slow network
disk."""
_NEEDED_BYTES = 256 << 20
"""Bytes that must be free on ``/dev/shm`` to use it for the messages of a worker process. If
``/dev/shm`` has less free space, the messages use files in the temporary folder."""
_NUM_LENT_BLOCKS = 2
"""Number of replies of a worker whose arrays may be alive without a copy. Two replies suffice,
because the worker computes a reply while the client process stores the previous reply."""
_EXIT_TIMEOUT_S = 5.0
_MPSFM_ERRORS: Mapping[str, type[MpsfmError]] = MappingProxyType(
    {
        name: getattr(errors, name)
        for name in ("InputError", "ConfigError", "ProviderError", "WeightsError", "OutputError")
    }
)


class WorkerLost(RuntimeError):
    """Error for a worker process that crashed or did not reply; the next call starts another."""


class Worker:
    """Client of one running worker process in another Python environment."""

    def __init__(self, python: Path, label: str) -> None:
        """Start a worker process and receive its protocol version.

        Args:
            python: Python interpreter of the environment.
            label: Name of the environment in error messages.

        Raises:
            ProviderError: The worker process does not start, or has another version of the message
                protocol.
        """
        self._label = label
        self._folder = create_shared_folder(_NEEDED_BYTES)
        folder = Path(self._folder.name)
        self._log = folder / "stderr"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [str(python), "-m", _MODULE, str(folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=_environment(),
                start_new_session=os.name == "posix",
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._channel = Channel(
            self._process.stdout,
            self._process.stdin,
            folder,
            "main",
            "worker",
            lent=_NUM_LENT_BLOCKS,
        )
        self._lock = threading.Lock()
        self._end = weakref.finalize(self, _end, self._process, self._folder)
        try:
            greeting = self._receive(_START_TIMEOUT_S, "did not start")
        except WorkerLost as error:
            raise ProviderError(
                f"{error}; create the environment again with 'mpsfm env remove' and "
                f"'mpsfm env create'"
            ) from error
        versions = greeting["protocol"], greeting["api"]
        if versions != (PROTOCOL, API_VERSION):
            self.close()
            raise ProviderError(
                f"{label} has mpsfm-core {greeting['core']}, whose protocol version "
                f"{versions} differs from {(PROTOCOL, API_VERSION)}: create the "
                f"environment again with 'mpsfm env create'"
            )

    @property
    def alive(self) -> bool:
        """True while the worker process is running."""
        return self._process.poll() is None

    def ask(
        self,
        request: Mapping[str, Any],
        timeout_s: float,
        resolve_weights: Callable[[str, str | None], Path] | None = None,
    ) -> Any:
        """Send a request to the worker process and wait for the reply.

        Args:
            request: Action of the worker and its arguments by name.
            timeout_s: Time limit in seconds for the reply.
            resolve_weights: Function that returns the path of a weights file, which the worker may
                request before it replies.

        Returns:
            Value in the reply of the worker.

        Raises:
            MpsfmError: Any MP-SfM exception that was raised in the worker.
            RuntimeError: The provider raised an exception of another type; the message has its type
                and text.
            WorkerLost: The worker process crashed or did not reply within the time limit.
        """
        with self._lock:
            self._send(dict(request))
            while True:
                answer = self._receive(timeout_s, f"did not answer within {timeout_s:g} s")
                if "resolve" in answer:
                    self._send(_resolved(resolve_weights, *answer["resolve"]))
                elif "error" in answer:
                    raise decode_error(answer["error"])
                else:
                    return answer["value"]

    def close(self) -> None:
        """End the worker process."""
        self._channel.close()
        self._end()

    def _send(self, message: Any) -> None:
        try:
            self._channel.send(message)
        except ChannelClosed as error:
            raise self._lost("") from error

    def _receive(self, timeout_s: float, late: str) -> Any:
        """Receive the next message, and kill a worker process that exceeds the time limit."""
        timed_out: list[bool] = []

        def kill() -> None:
            timed_out.append(True)
            _kill(self._process)

        timer = threading.Timer(timeout_s, kill)
        timer.daemon = True
        timer.start()
        try:
            return self._channel.receive()
        except ChannelClosed as error:
            raise self._lost(late if timed_out else "") from error
        finally:
            timer.cancel()

    def _lost(self, late: str) -> WorkerLost:
        """Release the worker's resources and return an error with the reason of its end."""
        try:
            code = self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            _kill(self._process)
            code = self._process.wait()
        reason = late or _ended(code)
        lines = self._log.read_text(errors="replace").strip().splitlines()
        last = f"; its last line: {lines[-1].strip()}" if lines else ""
        self.close()
        return WorkerLost(f"{self._label} {reason}{last}")


def _ended(code: int) -> str:
    """Describe the exit code of a worker process in words."""
    if code == -getattr(signal, "SIGKILL", 9):
        return "was killed from outside, most likely because memory ran out"
    if code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    return f"ended by itself (exit code {code})"


def _resolved(
    resolve: Callable[[str, str | None], Path] | None, uri: str, sha256: str | None
) -> dict[str, Any]:
    """Return the reply to a worker that requests a weights file, with its path or an error."""
    try:
        if resolve is None:
            raise ProviderError(f"weights {uri} cannot be resolved without a weight store")
        return {"value": resolve(uri, sha256)}
    except MpsfmError as error:
        return {"error": encode_error(error)}


def encode_error(error: BaseException) -> dict[str, Any]:
    """Encode an exception as a message to another process, see :func:`decode_error`."""
    kind = next((k.__name__ for k in type(error).__mro__ if k.__name__ in _MPSFM_ERRORS), "")
    if isinstance(error, SettingsError):
        problems = [[list(p.path), p.text, p.missing] for p in error.problems]
        return {"settings": problems, "text": str(error)}
    if isinstance(error, DataError):
        return {"field": error.field, "rule": error.rule, "text": str(error)}
    text = str(error) if isinstance(error, MpsfmError) else f"{type(error).__name__}: {error}"
    return {"kind": kind, "text": text}


def decode_error(message: Mapping[str, Any]) -> Exception:
    """Decode an exception that :func:`encode_error` encoded in the worker or client process."""
    if "settings" in message:
        problems = (
            SettingProblem(tuple(p), text, missing) for p, text, missing in message["settings"]
        )
        return SettingsError(tuple(problems))
    if "field" in message:
        return DataError(message["field"], message["rule"])
    return _MPSFM_ERRORS.get(message["kind"], RuntimeError)(message["text"])


def _environment() -> dict[str, str]:
    """Return the environment variables of this process without its Python search path."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a worker process and its child processes."""
    if process.poll() is None:
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _end(process: subprocess.Popen[bytes], folder: tempfile.TemporaryDirectory[str]) -> None:
    """Kill the worker process, close its pipes and remove its shared memory folder."""
    _kill(process)
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            # Closing a pipe to an ended process fails if buffered bytes were not written.
            except OSError:
                continue
    folder.cleanup()
