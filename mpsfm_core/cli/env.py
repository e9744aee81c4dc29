"""``mpsfm env``: Python environments for providers whose packages do not fit together."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Environments for providers that need their own.")

Name = Annotated[str, typer.Argument(help="Of the environment.")]


@app.command()
def create(
    name: Name,
    packages: Annotated[list[str], typer.Argument(help="For pip: plugins, or their folders.")],
    python: Annotated[str | None, typer.Option(help="Interpreter, by default this one.")] = None,
) -> None:
    """Make an environment with these packages beside the core, and show what it brings."""
    from mpsfm_core.providers.environments.environment import create_environment

    environment, found = create_environment(name, packages, python)
    typer.echo(f"{environment.folder}")
    _print_providers(environment.name, found)


@app.command("list")
def list_environments() -> None:
    """List the environments and their providers."""
    from mpsfm_core.providers.environments.environment import all_environments

    for environment in all_environments():
        typer.echo(f"{environment.name}: {environment.folder}")
        _print_providers(environment.name, environment.describe())


@app.command()
def refresh(name: Name) -> None:
    """Look again what an environment brings, after a change in it."""
    from mpsfm_core.providers.environments.environment import find_environment

    _print_providers(name, find_environment(name).refresh())


@app.command()
def remove(name: Name) -> None:
    """Remove an environment with all that is in it."""
    from mpsfm_core.providers.environments.environment import remove_environment

    remove_environment(name)


def _print_providers(name: str, found: list[dict[str, str]]) -> None:
    for entry in found:
        why = f", not usable: {entry['fault']}" if entry["fault"] else ""
        typer.echo(f"  {entry['kind']}: {entry['name']}@{name} ({entry['distribution']}){why}")
    if not found:
        typer.echo("  it brings no providers: install a plugin in it")
