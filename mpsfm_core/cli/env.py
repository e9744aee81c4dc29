"""``mpsfm env``: manage Python environments for providers with conflicting packages."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True, help="Manage environments for providers with conflicting packages."
)

Name = Annotated[str, typer.Argument(help="Name of the environment.")]


@app.command()
def create(
    name: Name,
    packages: Annotated[list[str], typer.Argument(help="Packages for pip: plugins or folders.")],
    python: Annotated[
        str | None, typer.Option(help="Use this interpreter; default: the running one.")
    ] = None,
) -> None:
    """Create an environment with mpsfm-core and the given packages, and list its providers."""
    from mpsfm_core.providers.environments.environment import create_environment

    environment, providers = create_environment(name, packages, python)
    typer.echo(f"{environment.folder}")
    _print_providers(environment.name, providers)


@app.command("list")
def list_environments() -> None:
    """List the Python environments and their providers."""
    from mpsfm_core.providers.environments.environment import all_environments

    for environment in all_environments():
        typer.echo(f"{environment.name}: {environment.folder}")
        _print_providers(environment.name, environment.describe())


@app.command()
def refresh(name: Name) -> None:
    """Update the list of providers after a change in an environment."""
    from mpsfm_core.providers.environments.environment import find_environment

    _print_providers(name, find_environment(name).refresh())


@app.command()
def remove(name: Name) -> None:
    """Delete a Python environment with all its packages."""
    from mpsfm_core.providers.environments.environment import remove_environment

    remove_environment(name)


def _print_providers(name: str, providers: list[dict[str, str]]) -> None:
    """Print a line per provider of a Python environment."""
    for entry in providers:
        fault = f", not usable: {entry['fault']}" if entry["fault"] else ""
        typer.echo(f"  {entry['kind']}: {entry['name']}@{name} ({entry['distribution']}){fault}")
    if not providers:
        typer.echo("  no providers; install a plugin in the environment")
