"""``mpsfm export``: convert results to the formats of other programs."""

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
        str, typer.Option("--to", metavar="FORMAT", help="Format to write; 'list' shows all.")
    ] = "list",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Write here; default: exports/FORMAT in DIR."
        ),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the photos, if moved since the run."),
    ] = None,
    turn: Annotated[
        bool | None,
        typer.Option(
            "--turn/--as-is",
            help="Rotate gravity to -z and center the scene; default: as the format requires.",
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
        typer.echo(f"  left out because the pose is not confirmed: {name}")
    typer.echo(f"written to {done['output']}")
