"""Export to COLMAP's text format."""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.data.errors import InputError
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.exports.source import ExportSource

ENTRIES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")


def write(source: ExportSource, folder: Path) -> None:
    """Write the COLMAP text model of the original images.

    Raises:
        InputError: an image name has a space, the field separator of COLMAP's text format.
    """
    for name in source.names:
        if len(name.split()) != 1:
            raise InputError(
                f"COLMAP's text format does not allow spaces in names such as {name!r}; rename the "
                f"photo, or export to a format that allows them, such as colmap-db or nerfstudio"
            )
    write_model(folder, source.model, text=True)
