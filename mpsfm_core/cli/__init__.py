"""The command ``mpsfm``: thin commands over the front door.

One module a command or command group, added to :func:`build_app`. A module imports what its
command needs inside of the command's function, so that every command starts as fast as it can.
Commands raise; :class:`~mpsfm_core.cli.errors.GuardedGroup` turns what they raise into one line
on stderr and an exit code.
"""

from __future__ import annotations

import logging
import os
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
    mesh,
    models,
    plugins,
    reconstruct,
    report,
    testsets,
    view,
)
from mpsfm_core.cli.errors import GuardedGroup


def main() -> None:
    """Entry point of the ``mpsfm`` command."""
    build_app()(prog_name="mpsfm")


def build_app() -> typer.Typer:
    """The command line with all its commands."""
    app = typer.Typer(
        cls=GuardedGroup,
        callback=_options,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_show_locals=False,  # they would print whole images
    )
    app.command("reconstruct")(reconstruct.reconstruct)
    app.command("demo")(demo.demo)
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


def _print_version(wanted: bool) -> None:
    if wanted:
        from mpsfm_core.providers.registry import core_version

        typer.echo(core_version())
        raise typer.Exit


def _options(
    debug: Annotated[
        bool, typer.Option("--debug", envvar="MPSFM_DEBUG", help="Show tracebacks and debug logs.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="And exit.")
    ] = False,
) -> None:
    """Structure-from-Motion with depth and normal priors from plugins."""
    logging.basicConfig(format="mpsfm: %(levelname)s: %(message)s", level=logging.WARNING)
    logging.getLogger("mpsfm_core").setLevel(logging.DEBUG if debug else logging.WARNING)
    if not debug:
        os.environ.setdefault("GLOG_minloglevel", "1")  # COLMAP logs what it creates
