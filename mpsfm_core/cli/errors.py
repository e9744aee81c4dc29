"""Error handling of commands: print one line on stderr and set the exit code.

The option ``--debug`` prints the traceback of the error. Exit codes: 0 success, 1 internal error or
machine failure, 2 wrong input or usage, 3 no reconstruction, 130 interrupted.
"""

from __future__ import annotations

import errno
import signal
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C or SIGTERM interrupted."""


class CommandGroup(TyperGroup):
    """Root command that turns exceptions of commands into messages and exit codes."""

    def invoke(self, ctx: Any) -> Any:
        """Run the selected command; convert exceptions to a message and an exit code."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            fail("interrupted", INTERRUPTED)
        except Exception as error:
            if _is_control_flow(error) or ctx.params.get("debug"):
                raise
            fail(*_explain(error))


def handle_sigterm() -> None:
    """Install a signal handler that makes SIGTERM end a command like Ctrl-C.

    Install the signal handler after the import of pycolmap, because pycolmap installs another
    signal handler.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr and exit."""
    typer.echo(f"mpsfm: {' '.join(message.split())}", err=True)
    raise typer.Exit(exit_code)


def _explain(error: Exception) -> tuple[str, int]:
    """Convert an exception to a message and an exit code."""
    from mpsfm_core.data.errors import MpsfmError

    if isinstance(error, MpsfmError):
        return str(error), error.exit_code
    # An OSError is a machine failure, for example a full disk or missing permissions.
    if isinstance(error, OSError):
        return str(error), 1
    name = type(error).__name__
    return f"internal error: {name}: {error} (run mpsfm --debug ... for a traceback)", 1


def _is_control_flow(error: Exception) -> bool:
    """Return True for exits, usage errors and closed pipes, which typer handles itself."""
    if isinstance(error, OSError):
        return error.errno == errno.EPIPE
    if isinstance(error, (typer.Exit, typer.Abort)):
        return True
    return hasattr(error, "format_message") and hasattr(error, "exit_code")
