"""Process that repeats a small reconstruction with a fault at a different system call.

The process loads ``failing_calls``, imports and compiles the package once, and forks for each run.
The process reads a JSON line with a request from stdin and writes a JSON line with the result.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

_LIMIT_S = 120


def disturbed(request: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct in a fork and return the signal, or the class and message of the error."""
    report = Path(request["report"])
    report.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        signal.alarm(_LIMIT_S)
        _reconstruct(request, report)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return {"signal": os.WTERMSIG(status)}
    return dict(json.loads(report.read_text()))


def _reconstruct(request: dict[str, Any], report: Path) -> None:
    from mpsfm_core.data import errors
    from mpsfm_core.pipeline import run as pipeline

    shim = ctypes.CDLL(None)
    shim.counted.restype = ctypes.c_long
    number = ctypes.c_long(request.get("number", -1))
    folder = request["folder"].encode()
    ended: dict[str, Any] = {"error": None, "expected": True}
    try:
        shim.arm(folder, number, request.get("errno", 0), request.get("lasting", 0))
        pipeline.reconstruct(
            request["images"], request["output"], request["config"],
            intrinsics=request["intrinsics"],
        )  # fmt: skip
    except BaseException as error:
        ended = {"error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}
        ended["expected"] = isinstance(error, (errors.MpsfmError, KeyboardInterrupt))
    calls = shim.counted()
    shim.arm(b"", ctypes.c_long(-1), 0, 0)
    report.write_text(json.dumps({**ended, "calls": calls}))


def main() -> None:
    """Answer requests until stdin ends; the first request compiles the kernels before any fork."""
    _reconstruct(json.loads(sys.stdin.readline()), Path(os.devnull))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        sys.stdout.write(json.dumps(disturbed(json.loads(line))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
