"""``mpsfm config``: which configurations there are and what one amounts to."""

from __future__ import annotations

from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Overrides

app = typer.Typer(no_args_is_help=True, help="Configurations and their effective settings.")


@app.command("list")
def list_configs() -> None:
    """List the configurations that come with the package."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.config import describe_shipped

    print_table(("name", "description"), describe_shipped().items())


@app.command("show")
def show(
    name: Annotated[str, typer.Argument(metavar="[NAME_OR_FILE]")] = "default",
    overrides: Overrides = None,
) -> None:
    """Print the effective configuration as YAML, with all defaults."""
    from mpsfm_core.config import load_config

    typer.echo(load_config(name, overrides or (), complete=False).to_yaml(), nl=False)
