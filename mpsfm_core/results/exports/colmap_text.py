"""Export to COLMAP's text format."""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.exports.tracks import check_names_without_spaces

ENTRIES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")


def write(source: ExportSource, folder: Path) -> None:
    """Write the COLMAP text model of the original images.

    Raises:
        InputError: an image name has a space, which COLMAP's text format does not allow.
    """
    check_names_without_spaces(source.names, "COLMAP's text format")
    write_model(folder, source.model, text=True)
