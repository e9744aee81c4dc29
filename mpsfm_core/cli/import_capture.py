"""Command ``mpsfm import``, which converts a phone capture with sensor depth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Quiet
from mpsfm_core.cli.errors import handle_sigterm


def import_capture(
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE", help="Raw data of Polycam, Record3D (.r3d) or Stray Scanner."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the converted files.")
    ],
    quiet: Quiet = False,
) -> None:
    """Convert a phone capture to DIR/images, DIR/poses and DIR/depth.

    The command prints the call of mpsfm reconstruct that uses the converted images, poses and depth
    maps.
    """
    from mpsfm_core.inputs.captures.convert import convert_capture
    from mpsfm_core.support.files import lock_output_folder

    handle_sigterm()
    with lock_output_folder(output):
        converted = convert_capture(capture, output)
    if quiet:
        return
    kinds = "images, poses and depth maps" if converted.depth else "images and poses"
    typer.echo(f"{converted.num_images} {kinds} of {converted.program}, written to {output}")
    command = f"mpsfm reconstruct {converted.images} --poses {converted.poses} --output RESULT"
    if converted.depth:
        command += f" --config sensor-depth --set depth.options.directory={converted.depth}"
    typer.echo(f"next: {command}")
