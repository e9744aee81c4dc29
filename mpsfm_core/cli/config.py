"""``mpsfm config``: which configurations there are and what one amounts to."""

from __future__ import annotations

from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Offline, Overrides, settings

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
    offline: Offline = False,
) -> None:
    """Print the effective configuration as YAML, with all defaults.

    Comments at its end say which providers a run would take here and now; nothing is downloaded.
    """
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry

    registry = Registry.discover()
    config = load_config(name, settings(overrides, offline), registry, complete=False)
    typer.echo(config.to_yaml(), nl=False)
    typer.echo("\n# here and now:")
    try:
        for choice in preview_providers(config, registry).choices:
            typer.echo(f"# {choice}")
    except InputError as error:
        typer.echo(f"# it does not run: {error}")
