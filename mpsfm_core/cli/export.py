"""``mpsfm export``: results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Quiet


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Result folder of a run, or a COLMAP model.")
    ],
    to: Annotated[
        str, typer.Option("--to", metavar="FORMAT", help="'list' shows them all.")
    ] = "list",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Default: exports/FORMAT below DIR."),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The photos, if they are not where the run found them."),
    ] = None,
    turn: Annotated[
        bool | None,
        typer.Option(
            "--turn/--as-is",
            help="Gravity along -z and the middle as origin; default: what suits the format.",
            show_default=False,
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a result in the format of another program."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.results.exports.formats import export as write
    from mpsfm_core.results.exports.formats import known_formats

    if to == "list":
        known = known_formats()
        print_table(("format", "what it is"), [(name, f.description) for name, f in known.items()])
        return
    done = write(folder, to, output, photos=images, turn=turn)
    if quiet:
        return
    typer.echo(f"{done['images']} images, {done['points']} points; {done['orientation']}")
    metres, spread = done["metres_per_unit"], done["scale_spread"]
    unit = "unknown" if metres is None else f"{metres:.3g} m, to about {spread:.0%}"
    typer.echo(f"  unit {unit}")
    for name in done["left_out"]:
        typer.echo(f"  left out, its pose is not confirmed: {name}")
    typer.echo(f"written to {done['output']}")
