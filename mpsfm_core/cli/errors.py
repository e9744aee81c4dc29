"""How a command ends: one line on stderr and an exit code, or a traceback with ``--debug``.

Exit codes: 0 success, 1 a fault of ours or of the machine, 2 wrong input or usage, 3 no
reconstruction was possible, 130 interrupted.
"""

from __future__ import annotations

import errno
import signal
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

from mpsfm_core.data.errors import MpsfmError

INTERRUPTED = 130


class GuardedGroup(TyperGroup):
    """The root command; nothing that a command raises gets past it as a bare traceback."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            fail("interrupted", INTERRUPTED)
        except Exception as error:
            if _is_control_flow(error) or ctx.params.get("debug"):
                raise
            fail(*_explain(error))


def heed_termination() -> None:
    """SIGTERM ends a command as Ctrl-C does. For after the import of pycolmap, which has a stack
    trace of its own printed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def fail(message: str, exit_code: int) -> NoReturn:
    """Print one line on stderr and leave."""
    typer.echo(f"mpsfm: {' '.join(message.split())}", err=True)
    raise typer.Exit(exit_code)


def _explain(error: Exception) -> tuple[str, int]:
    if isinstance(error, MpsfmError):
        return str(error), error.exit_code
    if isinstance(error, OSError):  # disk full, no permission, gone
        return str(error), 1
    name = type(error).__name__
    return f"internal error: {name}: {error} (mpsfm --debug ... shows where)", 1


def _is_control_flow(error: Exception) -> bool:
    """Exits, usage errors and closed pipes, which the command line library ends properly."""
    if isinstance(error, OSError):
        return error.errno == errno.EPIPE
    own = isinstance(error, (typer.Exit, typer.Abort))
    return own or (hasattr(error, "format_message") and hasattr(error, "exit_code"))
