"""Log of ``mpsfm plugins check`` in a file that survives a crash of the checking process."""

from __future__ import annotations

import faulthandler
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpsfm_core.testing import CheckResult

MAX_CHECK_S = 600.0
"""Time limit in seconds for one check, after which the checking process ends. Calls of providers
that return to Python are interrupted earlier."""
_STDERR = 2
"""File descriptor of standard error. ``sys.stderr`` may have none, because pytest replaces it."""
_CRASHED_LOADING, _ENDED = "crashed-loading", "ended"
"""Entries of the log that do not belong to a check."""


class CheckLog:
    """File with one line for each started and each finished contract check."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def start(self, provider: str, around: str, id: str) -> None:
        """Record that a check starts, and end the process if the check takes too long."""
        faulthandler.dump_traceback_later(MAX_CHECK_S, exit=True, file=_STDERR)
        self._append([provider, around, id, time.time()])

    def finish(self, result: CheckResult) -> None:
        """Record the result of a check."""
        faulthandler.cancel_dump_traceback_later()
        self._append(asdict(result))

    def end(self) -> list[CheckResult]:
        """Record the end of all checks, and return the results."""
        faulthandler.cancel_dump_traceback_later()
        self._append(_ENDED)
        return self.results()

    def fail_started(self, reason: str) -> CheckResult | None:
        """Record a failure of the check during which the process ended; return None without one."""
        entries = self._read()
        if not entries or not isinstance(entries[-1], list):
            return None
        from mpsfm_core.testing import CheckResult  # The import takes long, and few checks crash.

        provider, around, id, started = entries[-1]
        result = CheckResult(provider, around, id, "fail", reason, time.time() - started)
        self._append(asdict(result))
        return result

    def note_crash_while_loading(self) -> None:
        """Record that the process ended before the first check."""
        self._append(_CRASHED_LOADING)

    @property
    def has_crash_while_loading(self) -> bool:
        """True if a plugin may crash the process while it is loaded."""
        return _CRASHED_LOADING in self._read()

    def results(self) -> list[CheckResult]:
        """Return the results of all finished checks."""
        from mpsfm_core.testing import CheckResult

        return [CheckResult(**entry) for entry in self._read() if isinstance(entry, dict)]

    def checked(self) -> set[str]:
        """Return the providers and plugins of which at least one check has started."""
        return {entry[0] for entry in self._read() if isinstance(entry, list)}

    def _append(self, entry: Any) -> None:
        with self._path.open("a") as file:
            print(json.dumps(entry), file=file)

    def _read(self) -> list[Any]:
        return [json.loads(line) for line in self._path.read_text().splitlines()]
