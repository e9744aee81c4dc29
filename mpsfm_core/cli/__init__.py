"""Command line ``mpsfm``: commands that call the public API.

Each command or command group has a module, and :func:`build_app` adds all of them to the command
line. A command imports its dependencies inside its function, so that every command starts fast.
The class :class:`~mpsfm_core.cli.errors.CommandGroup` turns exceptions into one line on stderr and
an exit code.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import Annotated

import typer

from mpsfm_core.cli import (
    benchmark,
    cache,
    calibrate,
    config,
    demo,
    dense,
    doctor,
    env,
    evaluate,
    export,
    import_capture,
    localize,
    mesh,
    models,
    plugins,
    reconstruct,
    report,
    testsets,
    view,
    work_folder,
)
from mpsfm_core.cli.errors import CommandGroup


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
    """Build the command line with all commands."""
    app = typer.Typer(
        cls=CommandGroup,
        callback=_configure_logging,
        no_args_is_help=True,
        add_completion=False,
        # Rich takes a third of the time of `mpsfm --help` to import.
        rich_markup_mode=None,
        context_settings={"max_content_width": 110},
        # Tracebacks omit local variables, because these may be whole images.
        pretty_exceptions_show_locals=False,
    )
    app.command("reconstruct")(reconstruct.reconstruct)
    app.command("extract")(work_folder.extract)
    app.command("match")(work_folder.match)
    app.command("map")(work_folder.map_images)
    app.command("localize")(localize.localize)
    app.command("demo")(demo.demo)
    app.command("import")(import_capture.import_capture)
    app.command("dense")(dense.dense)
    app.command("mesh")(mesh.mesh)
    app.command("export")(export.export)
    app.command("report")(report.report)
    app.command("view")(view.view)
    app.command("doctor")(doctor.doctor)
    app.command("evaluate")(evaluate.evaluate)
    app.command("benchmark")(benchmark.benchmark)
    app.command("calibrate")(calibrate.calibrate)
    app.add_typer(plugins.app, name="plugins")
    app.add_typer(config.app, name="config")
    app.add_typer(env.app, name="env")
    app.add_typer(models.app, name="models")
    app.add_typer(cache.app, name="cache")
    app.add_typer(testsets.app, name="testsets")
    return app


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
