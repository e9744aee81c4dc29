"""``mpsfm dense``: compute depth maps and a point cloud for an existing model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Quiet, parse_overrides
from mpsfm_core.cli.errors import handle_sigterm


def dense(
    model: Annotated[
        Path,
        typer.Argument(help="COLMAP model, transforms.json with points, or mpsfm result folder."),
    ],
    images: Annotated[Path, typer.Argument(help="Folder of the photos.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Write the results here.")
    ],
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a setting of dense, e.g. max_size=1000."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Run multi-view stereo on the photos of a model and write depth maps and a point cloud.

    The output is DIR/depth, DIR/dense.ply and DIR/sparse. The depth search starts from the maps in
    MODEL/depth if MODEL is a result folder of mpsfm, else from the depth range of the model's
    points.
    """
    from mpsfm_core.data.options import parse_settings
    from mpsfm_core.dense.options import DenseOptions
    from mpsfm_core.pipeline.dense_models import densify_model

    handle_sigterm()
    report = densify_model(
        model, images, output, parse_settings(DenseOptions, parse_overrides(overrides))
    )
    if not quiet:
        ratios = report.confirmed.values()
        typer.echo(
            f"{len(ratios)} images, {sum(ratios) / len(ratios):.0%} of their pixels confirmed by "
            f"another view; written to {output}"
        )
