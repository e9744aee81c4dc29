"""``mpsfm plugins``: what is installed and what is wrong with it."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mpsfm_core.registry import ProviderStatus

app = typer.Typer(no_args_is_help=True, help="Installed plugins and their providers.")


@app.command("list")
def list_plugins(
    as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False,
) -> None:
    """List all providers: where they come from, licences, and whether they can be used."""
    from mpsfm_core.registry import Registry

    status = Registry.discover().status()
    if as_json:
        typer.echo(json.dumps([asdict(line) for line in status], indent=2, default=str))
    else:
        _print_table(status)


def _print_table(status: tuple[ProviderStatus, ...]) -> None:
    from rich.text import Text

    from mpsfm_core.cli.tables import print_table

    rows = [
        (
            line.kind,
            Text(line.name, style="bold" if line.available else "dim"),
            f"{line.distribution} {line.version}",
            f"{line.code_license} / {line.weights_license}" if line.kind != "plugin" else "",
            ", ".join(line.capabilities),
            _state(line),
        )
        for line in status
    ]
    print_table(
        ("kind", "name", "distribution", "licence of code / weights", "capabilities", "state"), rows
    )


def _state(line: ProviderStatus) -> str:
    if line.available:
        return "available"
    return f"unavailable: {line.reason}" + (f"; {line.install_hint}" if line.install_hint else "")
