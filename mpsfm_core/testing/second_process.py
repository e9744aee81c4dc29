"""Second process for contract checks, with another seed of Python's hash function.

All checks of this process share one second process, so that the second process imports each library
once.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import weakref
from functools import lru_cache
from pathlib import Path
from typing import IO

from mpsfm_core.support.child_process import subprocess_environment
from mpsfm_core.testing.outcome import CheckFailed


class SecondProcess:
    """Python process that runs one provider after another."""

    def __init__(self) -> None:
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - lives as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SCRIPT],
            env={**subprocess_environment(), "PYTHONHASHSEED": "4321"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        weakref.finalize(self, _stop, self._process, self._errors)

    def run(self, data: bytes) -> bytes:
        """Restore a contract case in the second process, and call its provider.

        Args:
            data: Pickled tuple of the values of :meth:`ContractCase.to_pickle`, an example and the
                auxiliary input of the provider.

        Returns:
            Pickled tuple of the output and the time in seconds to import and construct the
            provider. The first entry is a text if the provider cannot be imported.

        Raises:
            CheckFailed: the provider raises an exception or ends the process.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        with tempfile.TemporaryDirectory(prefix="mpsfm-second-process-") as folder:
            path = Path(folder, "input")
            path.write_bytes(data)
            try:
                print(path, Path.cwd(), sep="\t", file=self._process.stdin, flush=True)
                message = self._process.stdout.readline()
            except BrokenPipeError:
                message = ""
            if message != "\n":
                _start.cache_clear()
                reason = message.strip() or self._last_error()
                raise CheckFailed(f"the provider fails in a second process: {reason}")
            return path.with_suffix(".answer").read_bytes()

    def _last_error(self) -> str:
        """Return the last line on standard error of the process that ended."""
        self._process.wait()
        self._errors.seek(0)
        return (self._errors.read().strip().splitlines() or ["no message"])[-1]


def run_in_second_process(data: bytes) -> bytes:
    """Call :meth:`SecondProcess.run` of the second process, which is started at first use."""
    return _start(os.getpid(), tuple(sys.path)).run(data)


@lru_cache(maxsize=1)
def _start(pid: int, path: tuple[str, ...]) -> SecondProcess:
    """Return the second process of the process ``pid`` with a module search path."""
    return SecondProcess()


def _stop(process: subprocess.Popen[str], errors: IO[str]) -> None:
    process.kill()
    process.communicate()
    errors.close()


_SCRIPT = """
import os, pathlib, pickle, sys, time
# A provider may print, so the messages to the first process have a file of their own.
messages = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
from mpsfm_core.testing.contract_case import restore_case
for line in sys.stdin:
    path, folder = line.rstrip("\\n").split("\\t")
    path = pathlib.Path(path)
    os.chdir(folder)
    message = ""
    try:
        started = time.perf_counter()
        try:
            state, example, auxiliary = pickle.loads(path.read_bytes())
        except Exception as error:
            found = f"the provider cannot be imported in a second process: {error}", 0.0
        else:
            case = restore_case(*state)
            case.prepare(example, example.partner)
            case.provider
            seconds = time.perf_counter() - started
            found = case.run_on_view(example.view, example, auxiliary=auxiliary), seconds
        path.with_suffix(".answer").write_bytes(pickle.dumps(found))
    except Exception as error:
        message = f"{type(error).__name__}: {error}".replace("\\n", " ")
    print(message, file=messages, flush=True)
"""
