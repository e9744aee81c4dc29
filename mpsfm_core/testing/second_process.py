"""Second process for contract checks, with another seed of Python's hash function.

All checks of this process share one second process, so that the second process imports each library
once.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import weakref
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

from mpsfm_core.support.child_process import subprocess_environment
from mpsfm_core.support.time_limit import time_limit
from mpsfm_core.testing.outcome import CheckFailed

_TIMEOUT_S = 120.0
"""Time limit in seconds to construct and call a provider in the second process."""


class SecondProcess:
    """Python process that runs one provider after another."""

    def __init__(self) -> None:
        self.is_new = True
        """True until the process has imported a plugin or a provider."""
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - lives as long as the process
        # A killed process does not remove the temporary files of its provider.
        self._folder = Path(tempfile.mkdtemp(prefix="mpsfm-second-process-"))
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SCRIPT],
            env={**subprocess_environment(), "PYTHONHASHSEED": "4321", "TMPDIR": str(self._folder)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        weakref.finalize(self, _stop, self._process, self._errors, self._folder)

    def measure_import(self, modules: tuple[str, ...], heavy: tuple[str, ...]) -> Any:
        """Import plugin modules in the second process, which must be new.

        The function :func:`measure_import` describes arguments, result and errors.
        """
        return self._call("importing the plugin module fails", "measure_import", modules, heavy)

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
        path = self._folder / "input"
        path.write_bytes(data)
        what = "the provider fails in a second process"
        self._call(what, "run_provider", str(path), str(Path.cwd()))
        return path.with_suffix(".answer").read_bytes()

    def _call(self, what: str, function: str, *arguments: Any) -> Any:
        """Call a function of the second process and return its result.

        Args:
            what: Beginning of the error message if the call fails.
            function: Name of a function in :data:`_SCRIPT`.
            arguments: Arguments of the function that JSON can represent.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self.is_new = False
        try:
            print(json.dumps([function, arguments]), file=self._process.stdin, flush=True)
            with time_limit(_TIMEOUT_S, "the second process"):
                line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        except TimeoutError as late:
            _start.cache_clear()
            raise CheckFailed(f"{what}: {late}") from late
        error, result = json.loads(line) if line else (self._last_error(), None)
        if error:
            _start.cache_clear()
            raise CheckFailed(f"{what}: {error}")
        return result

    def _last_error(self) -> str:
        """Return the last line on standard error of the process that ended."""
        self._process.wait()
        self._errors.seek(0)
        return (self._errors.read().strip().splitlines() or ["no message"])[-1]


def run_in_second_process(data: bytes) -> bytes:
    """Call :meth:`SecondProcess.run` of the second process, which is started at first use."""
    return _start(os.getpid(), tuple(sys.path)).run(data)


@lru_cache(maxsize=8)
def measure_import(path: tuple[str, ...], modules: tuple[str, ...], heavy: tuple[str, ...]) -> Any:
    """Import plugin modules in a new process, once for all providers of a plugin.

    Args:
        path: Module search path.
        modules: Entry points of one plugin, such as ``module`` or ``module:attribute``.
        heavy: Names of heavy libraries.

    Returns:
        Import time in seconds and the names of imported heavy libraries.

    Raises:
        CheckFailed: a module cannot be imported.
    """
    shared = _start(os.getpid(), path)
    process = shared if shared.is_new else SecondProcess()
    return process.measure_import(modules, heavy)


@lru_cache(maxsize=1)
def _start(pid: int, path: tuple[str, ...]) -> SecondProcess:
    """Return the second process of the process ``pid`` with a module search path."""
    return SecondProcess()


def _stop(process: subprocess.Popen[str], errors: IO[str], folder: Path) -> None:
    process.kill()
    process.communicate()
    errors.close()
    shutil.rmtree(folder, ignore_errors=True)


_SCRIPT = """
import gc, json, os, pathlib, pickle, pkgutil, sys, time
# Importing libraries creates many objects, which garbage collection would visit again and again.
gc.set_threshold(100_000, 20, 100)
# A provider may print, so the messages to the first process have a file of their own.
messages = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
import threadpoolctl
import mpsfm_core.providers.registry

def measure_import(modules, heavy):
    before, started = set(sys.modules), time.perf_counter()
    for entry_point in modules:
        plugin = pkgutil.resolve_name(entry_point)
        list(getattr(plugin, "mpsfm_providers", tuple)())
    seconds = time.perf_counter() - started
    return seconds, sorted(set(heavy) & (set(sys.modules) - before))

def run_provider(path, folder):
    from mpsfm_core.testing.contract_case import restore_case
    path = pathlib.Path(path)
    os.chdir(folder)
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
        with threadpoolctl.threadpool_limits(1, user_api="blas"):
            found = case.run_on_view(example.view, example, auxiliary=auxiliary), seconds
    path.with_suffix(".answer").write_bytes(pickle.dumps(found))

for line in sys.stdin:
    function, arguments = json.loads(line)
    error = result = None
    try:
        result = globals()[function](*arguments)
    except Exception as caught:
        error = f"{type(caught).__name__}: {caught}".replace("\\n", " ")
    print(json.dumps([error, result]), file=messages, flush=True)
"""
