"""Command line ``mpsfm``: commands that call the public API.

Each command or command group has a module, which is imported when the command is used or listed. A
command imports its dependencies inside its function, so that every command starts fast. The class
:class:`~mpsfm_core.cli.errors.CommandGroup` turns exceptions into one line on stderr and an exit
code.
"""

from __future__ import annotations

import importlib
import io
import logging
import os
import sys
from collections import UserDict
from typing import Annotated, Any

import typer
import typer.main

from mpsfm_core.cli.errors import CommandGroup

_COMMANDS = {
    "reconstruct": "reconstruct:reconstruct",
    "extract": "work_folder:extract",
    "match": "work_folder:match",
    "map": "work_folder:map_images",
    "localize": "localize:localize",
    "demo": "demo:demo",
    "import": "import_capture:import_capture",
    "dense": "dense:dense",
    "mesh": "mesh:mesh",
    "export": "export:export",
    "report": "report:report",
    "view": "view:view",
    "doctor": "doctor:doctor",
    "evaluate": "evaluate:evaluate",
    "benchmark": "benchmark:benchmark",
    "calibrate": "calibrate:calibrate",
    "plugins": "plugins:app",
    "config": "config:app",
    "env": "env:app",
    "models": "models:app",
    "cache": "cache:app",
    "testsets": "testsets:app",
}
"""Module of :mod:`mpsfm_core.cli` with the function or command group of each command, in the order
of the help text."""


def main() -> None:
    """Run the ``mpsfm`` command."""
    _escape_unprintable_characters()
    build_app()(prog_name="mpsfm")


def _escape_unprintable_characters() -> None:
    """Print characters that are missing in the terminal's encoding as escape sequences."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def build_app() -> typer.Typer:
    """Build the command line, which imports each command on first use."""
    return _new_app(cls=_RootGroup, callback=_configure_logging, no_args_is_help=True)


def _new_app(**settings: Any) -> typer.Typer:
    return typer.Typer(
        add_completion=False,
        # Rich takes a third of the time of `mpsfm --help` to import.
        rich_markup_mode=None,
        context_settings={"max_content_width": 110},
        # Tracebacks omit local variables, because these may be whole images.
        pretty_exceptions_show_locals=False,
        **settings,
    )


class _RootGroup(CommandGroup):
    """Root command, whose commands are imported on first use."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _LazyCommands({**_COMMANDS, **self.commands})


class _LazyCommands(UserDict[str, Any]):
    """Commands by name, each stored as ``"module:name"`` until the command is used."""

    def __getitem__(self, name: str) -> Any:
        command = super().__getitem__(name)
        if isinstance(command, str):
            module, _, attribute = command.partition(":")
            target = getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
            app = _new_app()
            if isinstance(target, typer.Typer):
                app.add_typer(target, name=name)
            else:
                app.command(name)(target)
            command = self[name] = typer.main.get_group(app).commands[name]
        return command


def _print_version(requested: bool) -> None:
    """Print the version and exit if requested."""
    if requested:
        from mpsfm_core.providers.registry import core_version

        typer.echo(core_version())
        raise typer.Exit


def _configure_logging(
    debug: Annotated[
        bool, typer.Option("--debug", envvar="MPSFM_DEBUG", help="Show tracebacks and debug logs.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version."
        ),
    ] = False,
) -> None:
    """Structure-from-Motion with depth and normal priors from plugins."""
    logging.basicConfig(format="mpsfm: %(levelname)s: %(message)s", level=logging.WARNING)
    logging.getLogger("mpsfm_core").setLevel(logging.DEBUG if debug else logging.WARNING)
    if not debug:
        # The log level 1 of glog hides the info messages of COLMAP.
        os.environ.setdefault("GLOG_minloglevel", "1")
