"""``mpsfm config``: list configurations and show their effective settings."""

from __future__ import annotations

from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Offline, Overrides, config_overrides

app = typer.Typer(no_args_is_help=True, help="Configurations and their effective settings.")


@app.command("list")
def list_configs() -> None:
    """List the shipped configurations."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.config import describe_shipped

    print_table(("name", "description"), describe_shipped().items())


@app.command("show")
def show(
    name: Annotated[str, typer.Argument(metavar="[NAME_OR_FILE]")] = "default",
    overrides: Overrides = None,
    offline: Offline = False,
    expert: Annotated[
        bool, typer.Option("--expert", help="Also print expert settings that have their default.")
    ] = False,
) -> None:
    """Print the effective configuration as YAML.

    Expert settings appear if they differ from their default, or with --expert.

    Comments at the end list the providers that a run on this machine would use. Downloads nothing.
    """
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry

    registry = Registry.discover()
    config = load_config(name, config_overrides(overrides, offline), registry, complete=False)
    typer.echo(config.to_yaml(expert_settings=expert), nl=False)
    typer.echo("\n# providers on this machine:")
    try:
        for choice in preview_providers(config, registry).choices:
            typer.echo(f"# {choice}")
    except InputError as error:
        typer.echo(f"# cannot run: {error}")
