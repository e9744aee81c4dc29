"""``mpsfm mesh``: build a mesh from the depth maps of a result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Quiet, parse_overrides
from mpsfm_core.cli.errors import handle_sigterm


def mesh(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Result folder of a run or of mpsfm dense.")
    ],
    images: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the photos, if moved since the run."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set voxel_px, max_hole_px, max_triangles or max_texture_size.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Build a textured mesh from depth maps; write DIR/mesh.glb, mesh.obj and mesh.ply.

    The report of the folder, if any, is written again and shows the mesh.

    The command needs the libraries of pip install 'mpsfm-core[mesh]'.
    """
    from mpsfm_core.data.options import parse_settings
    from mpsfm_core.data.result_layout import REPORT
    from mpsfm_core.dense.options import MeshOptions
    from mpsfm_core.pipeline.dense_models import mesh_model
    from mpsfm_core.report.page import write_report

    handle_sigterm()
    surface = mesh_model(folder, images, parse_settings(MeshOptions, parse_overrides(overrides)))
    if (folder / REPORT).is_file():
        write_report(folder)
    if not quiet:
        typer.echo(f"{len(surface.triangles)} triangles; written to {folder}/mesh.*")
