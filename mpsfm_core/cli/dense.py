"""``mpsfm dense``: depth maps and a cloud for a model that is there already."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Quiet, parse_overrides
from mpsfm_core.cli.errors import handle_sigterm


def dense(
    model: Annotated[
        Path, typer.Argument(help="COLMAP model, transforms.json with points, or our output.")
    ],
    images: Annotated[Path, typer.Argument(help="Folder of its photos.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Is written.")],
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of dense, e.g. max_size=1000."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Measure depth in the photos of a model: DIR/depth, DIR/dense.ply and the model, DIR/sparse.

    The search starts from the maps in MODEL/depth if MODEL is an output folder of ours, else from
    the range of the model's points.
    """
    from mpsfm_core.data.options import parse_settings
    from mpsfm_core.dense.options import DenseOptions
    from mpsfm_core.pipeline.dense_models import densify_model

    handle_sigterm()
    report = densify_model(model, images, output, parse_settings(DenseOptions, parse_overrides(overrides)))
    if not quiet:
        shares = report.confirmed.values()
        typer.echo(
            f"{len(shares)} images, {sum(shares) / len(shares):.0%} of their pixels confirmed by "
            f"another view; written to {output}"
        )
